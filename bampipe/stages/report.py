"""Stage report: the stored results as a PDF, two pages for the browser, and figures."""

from pathlib import Path

from pydantic.dataclasses import dataclass as checked_dataclass

from bampipe.data.refusals import refusal
from bampipe.data.run_folder import RunFolder
from bampipe.files import write_text
from bampipe.progress import Progress
from bampipe.schema import STRICT

SUMMARY = "PDF, web page and page for exploring of everything found so far"
INPUTS = (
    "ingest/session.json",
    "ingest/trials.parquet",
    "ingest/samples.parquet?",
    "filter/filter.json?",
    "filter/setup.json?",
    "filter/kinematics.parquet?",
    "stiffness/stiffness.json?",
    "stiffness/loops.parquet?",
    "models/*/model.toml",
    "models/*/*.json",
    "models/*/*.parquet",
    "compare.json?",
    "run.json?",  # the keys of the other stages
)
OUTPUTS = ("report/report.pdf", "report/report.html", "report/explore.html", "report/figures/*.svg")


@checked_dataclass(frozen=True, config=STRICT)
class Config:
    """Settings of the stage.

    Attributes:
        detail_model: the model whose parameters and predictions are shown in detail; "" for the
            best confirmed one.
    """

    detail_model: str = ""


def execute(run: RunFolder, out: Path, config: Config, progress: Progress) -> dict[str, object]:
    """Write the report of whatever stages have run; ingest must have."""
    # matplotlib is slow to import: only here, so that other commands do not wait for it
    from bampipe.report.build import build_run_report
    from bampipe.report.run_results import Results

    report = build_run_report(Results(run.root, config.detail_model), progress)
    report.write(out / "report")
    return {
        "sections": list(report.sections),
        "figures": sorted(report.figures),
        "headline": f"report/report.pdf, report.html, explore.html; {len(report.figures)} figures",
    }


def write_page_of_two(first: Path, second: Path) -> Path:
    """Write the page of two runs beside the folder of the first, and return its path."""
    from bampipe.report.explorer.page import explorer_page
    from bampipe.report.run_results import Results

    results, beside = Results(first), Results(second)
    device, other = (one.session.device for one in (results, beside))
    if device != other:
        of = {"other": other, "first": first.name, "device": device}
        raise refusal("two_devices", str(second), **of)
    page = first.parent / f"{first.name}_beside_{second.name}.html"
    text = explorer_page(results, f"device {device}", beside)
    write_text(page, text.replace('href="report.html"', f'href="{first.name}/report/report.html"'))
    return page
