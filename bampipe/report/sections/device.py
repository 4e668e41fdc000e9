"""The device: numbers taken from drawings, with their sources, and what they do (Table II)."""

from collections.abc import Iterator

from bampipe.report.document import Block, Table
from bampipe.report.run_results import Results
from bampipe.report.wording import format_decimals, format_stated, format_unit
from bampipe.results.identify import IdentifyResult
from bampipe.results.performance import PerformanceResult

TITLE = "Device"
_LEAST_PERCENT = 0.005


def list_blocks(results: Results) -> Iterator[Block]:
    """Yield the constants, and those on which the estimates depend, if they are stored."""
    performance, identified = results.read(PerformanceResult), results.read(IdentifyResult)
    known = identified.identifiability if identified else None
    constants = performance.constants if performance else {}
    grouped = {name for group in (known.together if known else ()) for name in group.members}
    order = sorted(constants.items(), key=lambda item: (item[0] in grouped, item[0].lower()))
    yield Table(
        f"Numbers of the device file, none of them estimated{results.cite_paper('Table II')}",
        "Name :code | What ~1.6 | >Value | Unit :unit | Source ~1.2",
        [(n, c.description, format_stated(c.value), c.unit or "1", c.source) for n, c in order],
    ).drop_empty_columns()
    # The numbers as tested by the trials, and the estimates that depend on them.
    rows = []
    for one in known.numbers if known else ():
        moved = sorted(one.moves_percent.items(), key=lambda item: -abs(item[1]))[:2]
        most = [f"`{n}` {format_decimals(x, 2)} %" for n, x in moved if abs(x) >= _LEAST_PERCENT]
        value = f"{format_stated(one.value)} {format_unit(one.unit) or '1'}"
        rows.append((one.name, value, one.bound_sd, ", ".join(most) or "none by 0.01 %"))
    yield Table(
        "Numbers of the device file on which the estimates depend",
        "Number :code ~1.5 | >Value ~1 | >Least SD :2 ~0.6 | An error of 1 % would move ~2",
        rows,
        "Least SD: how well these trials could determine the number if it were estimated together "
        "with the parameters (Cramér-Rao bound).",
    )
