"""Generated parts of a model: facts about its equations, and the source of its functions.

The source has two parts, because most candidates of a diagnosis need only the first.
"""

from typing import Any

import sympy as sp

from bampipe import generated_code
from bampipe.model_functions import ROWS
from bampipe.physics import codegen
from bampipe.physics.derivation import derive
from bampipe.physics.equations import Equations, contribution
from bampipe.physics.memory_code import group_states, memory_source
from bampipe.physics.model import Model

Generation = tuple[dict[str, Any], dict[str, str]]
"""Facts, which JSON can hold, and the source of each module by name."""


def effects_code(model: Model) -> Generation:
    """Return the facts of a model, and the source of its effects' terms in the residual."""
    equations = _derive_once(model)
    bare = _derive_once(Model(model.device)) if model.effects else equations
    added = contribution(equations, bare)
    channels = dict(zip(equations.inputs, equations.u, strict=True))
    forces = [channels[name] for name in model.device.forces]
    brakes = {channels[name] for name in model.device.brakes.values() if name in channels}
    facts = {
        "memory": equations.z_names,
        "changes": [equations.z.index(z) for z in equations.changes],
        "inputs": equations.inputs,
        "noise": equations.noise,
        "linear": equations.dependence.linear,
        "products": equations.dependence.products,
        "constant": equations.dependence.constant,
        "touched": [i for i, e in enumerate(added) if e != 0],
        "moves_sensors": any(e != 0 for e in equations.offset),
        "moved_by": [
            i for i, p in enumerate(equations.p) if any(e.has(p) for e in equations.offset)
        ],
        "driven": any(sp.diff(e, force) != 0 for e in added for force in forces),
        "force_fed": any(e.has(*forces) for e in equations.rates),
        "moved_first": moved_first(model, equations, forces),
        "compensated": [i for i, e in enumerate(equations.compensation) if e != 0],
        "delays": equations.delays,
        "braked": any(brakes & e.free_symbols for e in (*added, *equations.rates)),
    }
    sources = {"columns": codegen.array_source(equations, added)}
    uncommanded, groups = {*forces, channels.get("t")}, []
    for k, places in enumerate(group_states(equations)):
        sources[f"memory{k}"], uses = memory_source(equations, places)
        commands = [c for c, i in enumerate(uses["u"]) if equations.u[i] not in uncommanded]
        group = {"module": f"memory{k}", "places": places, "uses": uses, "commands": commands}
        groups.append(group)
    return facts | {"state_groups": groups}, sources


def whole_code(model: Model) -> Generation:
    """Which slopes are the same everywhere, and the source of the whole mechanism's functions."""
    equations = _derive_once(model)
    slopes, places = codegen.slopes_source(equations)
    names, along = codegen.bodies_along_motion(equations)
    known, here = codegen.bodies_at_state(equations)
    lasting = enumerate(equations.dependence.lasting)
    facts = {
        "slopes": places,
        "lasting": [i for i, by_axis in lasting if by_axis is not None],
        "of_bodies": equations.dependence.of_bodies,
        "bodies": len(names),
    }
    sources = {
        "slopes": slopes,
        "dynamics": codegen.dynamics_source(equations),
        **codegen.rows_sources(equations, ROWS),
    }
    sources["residual"], title = codegen.residual_source(equations, names), ""
    if names:
        sources["bodies"], sources["compiled_bodies"] = along, here
        title = generated_code.module_title("compiled_bodies", here)
    return facts, sources | codegen.scalar_sources(equations, known, title)


def moved_first(model: Model, e: Equations, forces: list[Any]) -> list[list[int]]:
    """Return, by axis, the places in a state of the position and rate that a force acts on first.

    They are those of the axis, or of an effect's first state, a part that moves it through play.
    """
    n = len(e.q)
    found = [[i, n + i] for i in range(n)]
    axes = [coordinate.name for coordinate in model.device.coordinates]
    for item in model.effects:
        for state in item.effect.states[:1]:
            place = e.z_names.index(f"{item.prefix}.{state.name}")
            if (rate := e.rates[place]) in e.z and e.rates[e.z.index(rate)].has(*forces):
                axis = axes.index(item.axes[0])
                if e.other_now[axis].has(e.z[place]):
                    found[axis] = [2 * n + place, 2 * n + e.z.index(rate)]
    return found


_derived: dict[str, Equations] = {}
"""By `Model.key`, the last used last."""
_MOST_DERIVED = 4
"""Number of models kept: the device without effects, which every candidate needs, and recent
ones."""


def _derive_once(model: Model) -> Equations:
    """Equations of a model; those asked for last are kept."""
    known = _derived.pop(model.key, None) or derive(model)
    _derived[model.key] = known
    if len(_derived) > _MOST_DERIVED:
        del _derived[next(iter(_derived))]
    return known
