"""Write `schemas/<name>.schema.json` from the declarations: `python .ci/write_schemas.py`."""

from pathlib import Path

from bampipe.data.session import Session
from bampipe.declarations.accepted import Accepted
from bampipe.declarations.model import ModelFile
from bampipe.declarations.pipeline import Pipeline
from bampipe.physics.device import Device
from bampipe.physics.effect import Effect
from bampipe.results.compare import CompareResult
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.draft import DraftResult
from bampipe.results.filter import FilterResult
from bampipe.results.identify import IdentifyResult
from bampipe.results.ingest import IngestResult
from bampipe.results.lab import LabResult, TrendsResult
from bampipe.results.next import NextResult
from bampipe.results.performance import PerformanceResult
from bampipe.results.run import RunResult
from bampipe.results.setup import SetupResult
from bampipe.results.stiffness import StiffnessResult
from bampipe.results.terms import TermsResult
from bampipe.results.truth import TruthResult
from bampipe.results.validate import ValidateResult
from bampipe.results.viscous import ViscousResult
from bampipe.schema import Declaration, json_schema_text

FOLDER = Path(__file__).parent.parent / "schemas"
FILES: dict[str, type[Declaration]] = {
    "accepted": Accepted,
    "device": Device,
    "effect": Effect,
    "model": ModelFile,
    "pipeline": Pipeline,
    "session": Session,
    "compare": CompareResult,
    "diagnose": DiagnoseResult,
    "draft": DraftResult,
    "filter": FilterResult,
    "identify": IdentifyResult,
    "ingest": IngestResult,
    "lab": LabResult,
    "next": NextResult,
    "performance": PerformanceResult,
    "run": RunResult,
    "setup": SetupResult,
    "stiffness": StiffnessResult,
    "trends": TrendsResult,
    "truth": TruthResult,
    "validate": ValidateResult,
    "terms": TermsResult,
    "viscous": ViscousResult,
}


if __name__ == "__main__":
    for name, kind in FILES.items():
        (FOLDER / f"{name}.schema.json").write_text(json_schema_text(kind), encoding="utf-8")
