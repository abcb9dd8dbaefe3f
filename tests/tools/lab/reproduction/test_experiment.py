"""Results are stored, and experiments repeated only if a dependency has changed."""

from __future__ import annotations

import json
from dataclasses import dataclass
from itertools import count

import pytest

from rack.tools.console.answer import Failure
from rack.tools.lab.reproduction.experiments import experiment
from rack.tools.lab.reproduction.experiments.experiment import (
    RESULTS_FOLDER,
    Experiment,
    RequirementMissing,
    Workshop,
    describe_dependencies,
    list_program_files,
    load_result,
    run_and_store,
)


@dataclass(frozen=True)
class Times:
    """Number of times that an experiment was made."""

    times: int


def count_runs() -> Experiment[Times]:
    """Return an experiment that counts its runs."""
    runs = count(1)
    return Experiment("counted", "counting", 1.0, Times, lambda workshop: Times(next(runs)))


def test_a_result_is_valid_until_the_program_changes(
    workshop: Workshop, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = count_runs()
    assert load_result(one, workshop.folder) is None
    first = run_and_store(one, workshop)
    assert load_result(one, workshop.folder) == first
    # The dependencies are stored with the result.
    document = json.loads((workshop.folder / RESULTS_FOLDER / "counted.json").read_text())
    assert document["depends"] == json.loads(json.dumps(describe_dependencies()))
    assert {"program", "machine"} <= set(document["depends"])
    monkeypatch.setattr(experiment, "compute_program_checksum", lambda: "another")
    assert load_result(one, workshop.folder) is None
    assert run_and_store(one, workshop).found["times"] == 2


@pytest.mark.parametrize(
    "rest", ['{"found": ', "[]", "{}", '{"found": 1, "took_s": 1, "made_at": "", "lacking": ""}']
)
def test_an_experiment_with_an_invalid_result_is_made_again(rest: str, workshop: Workshop) -> None:
    (workshop.folder / RESULTS_FOLDER / "counted.json").write_text(rest)
    assert load_result(count_runs(), workshop.folder) is None


def test_a_missing_requirement_is_stored_as_a_reason_and_a_failure_is_not(
    workshop: Workshop,
) -> None:
    def lack(workshop: Workshop) -> Times:
        raise RequirementMissing("no second processor")

    def fail(workshop: Workshop) -> Times:
        raise Failure("the rack did not run")

    lacking, failing = (Experiment(make.__name__, "", 1.0, Times, make) for make in (lack, fail))
    run_and_store(lacking, workshop)
    found = load_result(lacking, workshop.folder)
    assert found is not None
    assert found.lacking == "no second processor"
    with pytest.raises(Failure, match="did not run"):
        run_and_store(failing, workshop)
    assert load_result(failing, workshop.folder) is None


def test_results_depend_on_the_program_but_not_on_the_modules_that_write_the_page() -> None:
    folders = {path.parent.name for path in list_program_files()}
    assert {"mailbox", "servo", "benches", "experiments", "configs"} <= folders
    assert not {"reproduction", "sections"} & folders
