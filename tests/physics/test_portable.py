"""Exported functions of inverse dynamics against the compiled model, run as their users would."""

import ctypes
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_arm import ARM

from bampipe.errors import InputError
from bampipe.physics import Model, compile_model, registry
from bampipe.physics.portable import portable_source


def models() -> list[Model]:
    arm = registry.device_from(ARM)
    return [
        Model(arm),
        Model(arm, ["friction_of_sum:one-two", "stribeck:one", "load_dependent_friction:two"]),
        Model(registry.device("bam"), ["quadratic_drag:yaw"]),
    ]


def sample(model: Model) -> tuple[np.ndarray, ...]:
    system = compile_model(model)
    rng, n = np.random.default_rng(5), len(system.coordinates)
    q, qd, qdd = rng.uniform(0.1, 0.8, (3, 30, n))
    u = rng.normal(size=(30, len(system.inputs)))
    p = rng.uniform(0.1, 0.6, len(system.parameters))
    return q, qd, qdd, u, p, system.required(q, qd, qdd, np.zeros((30, 0)), u, p)


def printed(model: Model) -> tuple[dict[str, Any], np.ndarray, list[np.ndarray], np.ndarray]:
    """What the Python text defines, parameters, arguments of the function, and true forces."""
    q, qd, qdd, u, p, required = sample(model)
    space: dict[str, Any] = {}
    exec(portable_source(model, p, "python"), space)
    inputs = compile_model(model).inputs
    used = [inputs.index(name) for name in space["INPUTS"]]
    return space, p, [q, qd, qdd, *([u[:, used]] if used else [])], required


@pytest.mark.parametrize("model", models(), ids=lambda m: f"{m.device.name}_{len(m.effects)}")
def test_python(model: Model) -> None:
    space, _, given, required = printed(model)
    found = [space["inverse_dynamics"](*row) for row in zip(*given, strict=True)]
    np.testing.assert_allclose(found, required, rtol=1e-10, atol=1e-10)
    assert space["COORDINATES"] == tuple(c.name for c in model.device.coordinates)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
@pytest.mark.parametrize("model", models(), ids=lambda m: f"{m.device.name}_{len(m.effects)}")
def test_c(model: Model, tmp_path: Path) -> None:
    _, p, given, required = printed(model)
    source, library = tmp_path / "model.c", tmp_path / "model.so"
    source.write_text(portable_source(model, p, "c"))
    command = ["cc", "-std=c99", "-Wall", "-Werror", "-O1", "-shared", "-fPIC", "-o"]
    subprocess.run([*command, str(library), str(source), "-lm"], check=True)
    function = ctypes.CDLL(str(library)).inverse_dynamics
    pointer = ctypes.POINTER(ctypes.c_double)
    for k in range(len(required)):
        out = np.empty(required.shape[1])
        rows = [np.ascontiguousarray(part[k]) for part in given]
        function(*(row.ctypes.data_as(pointer) for row in [*rows, out]))
        np.testing.assert_allclose(out, required[k], rtol=1e-10, atol=1e-10)


def test_models_with_memory_or_of_what_encoders_read_are_refused() -> None:
    model = Model(registry.device("bam"), ["presliding:yaw"])
    p = compile_model(model).prior
    with pytest.raises(InputError, match="has internal states"):
        portable_source(model, p, "c")
    model = Model(registry.device("bam"), ["encoder_scale:yaw"])
    with pytest.raises(InputError, match="acts on encoder readings"):
        portable_source(model, compile_model(model).prior, "python")


def test_the_offset_of_a_drive_is_no_part_of_the_force_and_is_named() -> None:
    device = registry.device("bam")
    name = f"force_bias:{device.components[0]}"
    bare, biased = Model(device), Model(device, [name])
    p = compile_model(biased).prior + 0.1
    without = portable_source(bare, p[: len(bare.parameters)], "python")
    text = portable_source(biased, p, "python")
    assert f"logged values differ by {name}." in text
    said = f" Forces are those that act; logged values differ by {name}."
    assert text.replace(said, "") == without
