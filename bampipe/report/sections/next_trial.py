"""The trial to record next, its expected gain, and the limits of the present trials."""

from collections.abc import Iterator, Mapping, Sequence

from bampipe.phrases.forecast_outcome import compare_forecasts, read_forecasts
from bampipe.phrases.proposal import say_chance
from bampipe.report.document import Block, Callout, Table
from bampipe.report.run_results import Results
from bampipe.report.wording import format_digits
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.identify import IdentifyResult
from bampipe.results.next import Detectable, ExpectedSd, NextResult, PlannedConfusion, PlannedSd

TITLE = "What to record next"


def list_blocks(results: Results) -> Iterator[Block]:
    """Yield the proposed trial and its expected gain, if there is one."""
    found = results.read(NextResult)
    if found is None:
        return
    yield Callout("note", "The next trial", found.sentence)
    yield f"{found.why} {found.expected}"
    best, inertial = found.proposals[0], set[str]()
    if identified := results.read(IdentifyResult):
        inertial = {*identified.inertial}
        forecasts = read_forecasts(results.root, results.model)
        lines = compare_forecasts(forecasts, identified, results.read(DiagnoseResult))
        yield tuple(one.replace("RUN", results.root.name) for one in lines)
    heads = ("with the present trials", "with the next one")
    yield tabulate_confusion("Probability of confusing two effects", heads, best.confusion)
    sds = {name: sd for name, sd in best.sd.items() if name not in inertial}
    yield tabulate_sds("Standard deviation of each parameter, now and with the next trial", sds)

    def factor(pair: tuple[str, Detectable]) -> float:
        return float("inf") if pair[1].smallest is None else pair[1].smallest / pair[1].typical

    rows = []
    for name, one in sorted(found.sensitivity.items(), key=factor, reverse=True):
        sizes = (one.smallest, one.with_proposal, one.typical)
        strength = one.parameter.rpartition(".")[2]
        rows.append((name, one.axis or None, strength, *sizes, one.unit or "1"))
    yield Table(
        "The smallest strength of each effect that these trials would have revealed",
        "Effect :code | Axis | Strength :code | >now :2 | >with the next :2 | >typical :2"
        " | Unit :unit",
        rows,
        "With 90 % probability, for the typical shape of the effect. A dash: such trials do not "
        "reveal it at any size, or the model's own parameters imitate it. Typical: the strength at "
        "which it is clearly visible. A number may grow with the next trial: errors are means over "
        "all trials, and the next one may excite an effect less than the present ones do.",
    )


def tabulate_confusion(
    title: str, heads: tuple[str, str], pairs: Sequence[PlannedConfusion]
) -> Table:
    """Tabulate the probability of confusing two effects, without and with new trials."""
    rows = [
        (" or ".join(f"`{n}`" for n in p.between), say_chance(p.before), say_chance(p.after))
        for p in pairs
    ]
    return Table(title, f"Effects | >{heads[0]} | >{heads[1]}", rows)


def tabulate_sds(title: str, entries: Mapping[str, ExpectedSd]) -> Table:
    """Tabulate the standard deviations of parameters, without and with new trials.

    Args:
        title: of the table; entries: by parameter, in a plan with the required limit.
    """
    rows = []
    for name, one in entries.items():
        values = (one.after,) if one.is_sharp else (one.low, one.high)
        expected = " to ".join(format_digits(value, 2) for value in values)
        asked = one.asked if isinstance(one, PlannedSd) else ""
        rows.append((name, one.before, expected, asked, one.unit))
    note = "A range is given where one number cannot be trusted: eight of ten results lie in it."
    wide = not all(one.is_sharp for one in entries.values())
    columns = "Parameter :code | >now :2 | >expected | >asked :2 | Unit :unit"
    return Table(title, columns, rows, note if wide else "").drop_empty_columns()
