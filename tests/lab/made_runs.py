"""Run folders with results of known content, for what reads many of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from made_results import diagnosis, write_model, write_result

from bampipe.data import store
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.floor import compare_with_floor
from bampipe.results.identify import IdentifyResult
from bampipe.results.ingest import IngestResult
from bampipe.results.run import RunResult
from bampipe.results.stiffness import StiffnessResult
from bampipe.results.validate import ValidateResult

AXES = ("yaw", "pitch")


@dataclass(frozen=True)
class Made:
    """What a made run says; ``recorded`` in ISO 8601, ``sd`` of every parameter.

    Attributes:
        child: effect added, and estimates with it.
        verdicts: verdict and effects by axis; None where no diagnosis was made.
        error: held-out error over the floor, by axis.
    """

    name: str
    recorded: str | None = None
    parameters: Mapping[str, float] = field(default_factory=dict)
    sd: float = 0.01
    child: tuple[str, Mapping[str, float]] | None = None
    verdicts: Mapping[str, tuple[str, Sequence[str]]] | None = None
    error: Mapping[str, float] = field(default_factory=lambda: {"yaw": 1.0, "pitch": 1.0})
    stiffness: float | None = None
    device: str = "bam"

    def write(self, runs: Path) -> Path:
        root = runs / self.name
        axes = {axis: {"unit": "rad", "resolution": 1e-4} for axis in AXES}
        session = {"session_id": self.name, "device": self.device, "recorded_at": self.recorded}
        write_result(root, IngestResult, **session, sample_rate_hz=500.0, axes=axes)
        trials = {
            "trial_id": ["t1", "t2"], "kind": ["free"] * 2, "status": ["ok", "set_aside"],
            "reason": ["", "t2.csv, row 7: time goes backwards"], "repairs": [""] * 2,
            "n_samples": [8000, 0], "duration_s": [16.0, 0.0], "sample_rate_hz": [500.0] * 2,
        }  # fmt: skip
        store.write_parquet(root / "ingest/trials.parquet", trials)  # type: ignore[arg-type]
        stiff = {"stiffness": self.stiffness, "sd": 1.0, "unit": "N.m/rad", "n_cycles": 6}
        axes = {} if self.stiffness is None else {"yaw": stiff | {"cycles": [{"trial_id": "t3"}]}}
        write_result(root, StiffnessResult, axes=axes)
        self._model(root, "base", (), self.parameters, self.error)
        if self.verdicts is not None:
            axes = {
                axis: {"verdict": verdict, "sentence": f"{axis}: {verdict}", "unit": "N.m"}
                for axis, (verdict, _) in self.verdicts.items()
            }
            effects = tuple(name for _, found in self.verdicts.values() for name in found)
            fields = diagnosis(axes, {effects: 1.0})
            write_result(root, DiagnoseResult, model="base", **fields)
        if self.child is not None:
            effect, parameters = self.child
            name = f"base+{effect.replace(':', '.')}"
            self._model(root, name, (effect,), parameters, dict.fromkeys(AXES, 1.0))
        write_result(root, RunResult)
        return root

    def _model(
        self,
        root: Path,
        name: str,
        effects: tuple[str, ...],
        parameters: Mapping[str, float],
        error: Mapping[str, float],
    ) -> None:
        write_model(root, name, *effects)
        known = {"sd": self.sd, "unit": "N.m", "at_bound": False}
        entries = {key: {"estimate": value, **known} for key, value in parameters.items()}
        nis = {"by_trial": {"t1": 1.1}}
        write_result(root, IdentifyResult, model=name, method="ukf", parameters=entries, nis=nis)
        axes = {
            axis: {
                "held_out_rmse": 0.02 * ratio, "noise_floor": 0.02, "unit": "N.m",
                "standing": compare_with_floor(0.02 * ratio, 0.02),
            }
            for axis, ratio in error.items()
        }  # fmt: skip
        write_result(root, ValidateResult, model=name, axes=axes)
