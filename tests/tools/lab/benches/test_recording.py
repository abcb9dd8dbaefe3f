"""The bench of recording: what the turns of each phase have shown, compared with those without."""

from __future__ import annotations

import pytest

from rack.tools.lab.benches.recording import PHASES, PhaseCost, costs


def test_every_phase_is_compared_with_the_one_without_a_recorder() -> None:
    turns = {phase: [PhaseCost([0.1, 0.1 + n], 0.5 * n, 2.0 * n)] for n, phase in enumerate(PHASES)}
    found = costs("servo", turns)
    late, missed, processor = found.cases
    assert late == "lateness of servo"
    one = found.sample(late, "live viewer")
    assert one is not None
    assert (one.count, found.ratio(one)) == (2, pytest.approx(1.1 / 0.1))
    # Without a recorder nothing was missed: there is no ratio to nothing.
    shares = [found.sample(case, "recording") for case in (missed, processor)]
    assert [share and (share.median, found.ratio(share)) for share in shares] == [
        (0.5, None),
        (2.0, None),
    ]
