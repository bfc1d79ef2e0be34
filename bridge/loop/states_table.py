"""The supervisor's table as documentation: ``python -m gapbridge.bridge.loop.states_table``."""

from __future__ import annotations

from gapbridge.bridge.loop.supervisor import TRANSITIONS, Cause, State


def states_table() -> str:
    """Return the table of transitions in Markdown: what each cause leads to from each state."""
    names = [state.name.lower() for state in State]
    lines = [f"| cause | {' | '.join(names)} |", "| --- " * (len(names) + 1) + "|"]
    for cause in Cause:
        after = [TRANSITIONS.get((state, cause)) for state in State]
        cells = ["" if state is None else state.name.lower() for state in after]
        lines.append(f"| {cause.value} | {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    print(states_table())
