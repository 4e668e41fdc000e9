"""What an identified model hands on to the stages after it."""

import numpy as np
import pytest
from made_results import write_result

from bampipe.data.run_folder import RunFolder
from bampipe.declarations.model_file import identified
from bampipe.errors import InputError
from bampipe.physics import Model, compile_model, registry
from bampipe.results.identify import IdentifyResult


def test_what_is_fixed_stands_at_its_prior_and_what_is_missing_is_named(tmp_path):
    system = compile_model(
        Model(registry.device("servo_pendulum"), ["load_dependent_friction:joint"])
    )
    free = [item.name for item in system.parameters if not item.fixed]
    assert len(free) < len(system.parameters)
    found = {name: {"estimate": 1.0 + k, "sd": 0.1} for k, name in enumerate(free)}
    write_result(tmp_path, IdentifyResult, parameters=found)
    p = identified(RunFolder(tmp_path), "base", system)
    for item, value in zip(system.parameters, p, strict=True):
        assert value == (item.prior if item.fixed else found[item.name]["estimate"])
    assert np.isfinite(p).all()
    del found["armature"]
    write_result(tmp_path, IdentifyResult, parameters=found)
    with pytest.raises(InputError, match=r"identify\.json: no parameter 'armature'; bampipe iden"):
        identified(RunFolder(tmp_path), "base", system)
    with pytest.raises(InputError, match="bampipe identify"):
        identified(RunFolder(tmp_path), "other", system)
