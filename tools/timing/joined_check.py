"""Predicted responses across racks, for `rack check` with several configs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass

from rack.boards.timing.joined import JoinedRacks, Station, format_joined_levels
from rack.tools.console.answer import Document, Failure


@dataclass(frozen=True)
class JoinedVerdict:
    """Predicted response along parallel chains across racks, and its limit.

    Attributes:
        levels: Boards of each level as text, the highest first.
        command_ms: Longest response of a command.
        status_ms: Longest response of a status. None if no status passes all links.
        limit_ms: Goal of the highest rack, or the bound of eq. 3.2.
        limit: Name of the limit.
        sum_eq_3_3_ms: Sum of eq. 3.3, where links count as levels.
    """

    levels: tuple[str, ...]
    command_ms: float
    status_ms: float | None
    limit_ms: float
    limit: str
    sum_eq_3_3_ms: float

    @property
    def holds(self) -> bool:
        """Whether both responses are within the limit."""
        return max(self.command_ms, self.status_ms or 0.0) <= self.limit_ms

    def to_document(self) -> Document:
        """Return the verdict as plain data."""
        return asdict(self) | {"holds": self.holds}


def judge_joined_racks(joined: JoinedRacks) -> list[JoinedVerdict]:
    """Compare the response along every chain across racks with its limit.

    Raises:
        Failure: A link has no delay budget, or no command passes between the racks.
    """
    for link in joined.unbudgeted_links:
        raise Failure(
            f"rack {link.rack}: adapter.lan.import.{link.port} has no delay_ms: the longest time in"
            f" ms that a message of {link.source} may take on the network, such as delay_ms = 20",
            2,
        )
    if not joined.chains:
        names = ", ".join(joined.racks)
        raise Failure(f"no command passes between these racks: {names}", 2)
    groups: dict[object, list[tuple[Station, ...]]] = {}
    for chain in joined.chains:
        times = joined.compute_response_ns(chain), joined.compute_response_ns(chain[::-1])
        groups.setdefault((chain[0], chain[-1], len(chain), times), []).append(chain)
    return [_judge_chains(joined, chains) for chains in groups.values()]


def _judge_chains(joined: JoinedRacks, chains: Sequence[tuple[Station, ...]]) -> JoinedVerdict:
    """Compare the response along parallel chains, which is equal, with its limit."""
    chain = chains[0]
    goal_ns = joined.racks[chain[0].rack].response_goal_ns
    upward = chain[::-1]
    bound_ns, sum_ns = joined.compute_bounds_ns(chain)
    has_status = joined.list_chain_links(upward) is not None
    return JoinedVerdict(
        levels=format_joined_levels(chains),
        command_ms=joined.compute_response_ns(chain) * 1e-6,
        status_ms=joined.compute_response_ns(upward) * 1e-6 if has_status else None,
        limit_ms=(bound_ns if goal_ns is None else goal_ns) * 1e-6,
        limit="n R_max, eq. 3.2" if goal_ns is None else "timing.response_ms",
        sum_eq_3_3_ms=sum_ns * 1e-6,
    )


def format_joined_verdicts(verdicts: Sequence[JoinedVerdict]) -> Iterator[str]:
    """Yield the verdict on the response across racks, and a line for each group of chains."""
    failing = [verdict for verdict in verdicts if not verdict.holds]
    word = "fits" if not failing else "does not fit"
    yield f"across racks: {word}: {len(verdicts) - len(failing)} of {len(verdicts)} responses hold"
    for verdict in verdicts:
        status = "not passed on" if verdict.status_ms is None else f"{verdict.status_ms:g} ms"
        mark = "" if verdict.holds else "FAILS: "
        yield (
            f"  {mark}a command down {verdict.command_ms:g} ms, a status up {status}; limit"
            f" {verdict.limit_ms:g} ms ({verdict.limit})"
        )
        yield f"    {' > '.join(verdict.levels)}"
