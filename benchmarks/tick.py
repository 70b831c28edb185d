"""Milliseconds of a planner tick beside the planning: what each part adds, measured in the loop.

The bars: filter, safety and logging hand-off together under 3 ms at the 99th percentile, of which
logging adds under 1 ms, also with a disk that hangs and a viewer that died; a control tick with the
checks of readings takes at most 5 % longer at the 99th percentile than without. All cases of a part
take turns, a second each at 25 Hz, so that drift hits all alike.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from report import parser, publish
from tick_control import control_figures
from tick_filter import filter_figures
from tick_logging import logging_figures

#: Part of a tick -> its figures, from the number of seconds to measure each case for.
PARTS: Mapping[str, Callable[[int], dict[str, object]]] = {
    "control": control_figures,
    "filter": filter_figures,
    "logging": logging_figures,
}


def main() -> None:
    p = parser(__doc__)
    p.add_argument("--parts", nargs="*", choices=sorted(PARTS), default=sorted(PARTS))
    args = p.parse_args()
    figures: dict[str, object] = {}
    for part in args.parts:
        figures |= PARTS[part](args.rounds)
    publish(figures, args.json)


if __name__ == "__main__":
    main()
