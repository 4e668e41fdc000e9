"""The compiled model: generated functions, loaded from a cache on disk if they exist."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cached_property
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from bampipe import generated_code
from bampipe.arrays import Array, Indices
from bampipe.physics.device import INPUT_ORDERS, derivative
from bampipe.physics.memory import StateGroup, StateKey
from bampipe.physics.model import Model
from bampipe.physics.newton_euler import INERTIAL
from bampipe.physics.parameter import Parameter

if TYPE_CHECKING:  # it brings sympy, which few need
    from bampipe.physics.model_code import Generation

_TOGETHER = 1024
"""Samples whose slopes by a robot's bodies are computed at once, to fit the processor's cache."""


def _compiled(name: str) -> cached_property[Callable[..., None]]:
    """The compiled function ``name`` of a system, in the module of that name."""
    return cached_property(lambda system: getattr(system._whole.module(name), name))


class System:
    """Generated functions of one model. Made by `compile_model`.

    Attributes:
        model: what it was made from.
        coordinates, coordinate_units, torque_units: per generalised coordinate.
        states: names of the full state x: positions, rates, internal states.
        inputs: names of the columns of u. parameters: those in p, in order.
        noise: names of the additive process noise w. changes: states whose rates `memory` appends.
        linear: per parameter, whether the residual is linear in it; of several, see `is_linear_in`.
        constant: per parameter, whether the slope of the residual by it depends on no parameter
            along the mechanism's true motion.
        touched: axes whose equation the effects change, measurement effects aside.
        moves_sensors: whether an effect of kind ``measurement`` is present.
        moved_by: numbers of the parameters of its `offset`.
        driven: whether the effects' terms in the residual depend on the measured force of the same
            moment; force_fed: whether the rate of an internal state does.
        moved_first: by axis, the places among `states` of the position and rate that a force there
            acts on first, (n_q, 2).
        compensated: axes with a gravity compensator; see `compensation`.
        delays: names of the parameters that shift measured forces in time. braked: whether the
        effects' terms depend on a brake's command.
    """

    def __init__(self, model: Model, code: generated_code.Generated) -> None:
        self.model = model
        self._code = code
        meta = code.facts
        axes = model.device.coordinates
        self.coordinates: tuple[str, ...] = tuple(c.name for c in axes)
        self.coordinate_units = tuple(c.unit for c in axes)
        self.torque_units: tuple[str, ...] = tuple(c.torque_unit for c in axes)
        self.memory_names: tuple[str, ...] = tuple(meta["memory"])
        self.changes: tuple[int, ...] = tuple(meta["changes"])
        self.states: tuple[str, ...] = (
            *self.coordinates,
            *(f"{c}_rate" for c in self.coordinates),
            *self.memory_names,
        )
        self.inputs: tuple[str, ...] = tuple(meta["inputs"])
        self.noise: tuple[str, ...] = tuple(meta["noise"])
        self.parameters: tuple[Parameter, ...] = model.parameters
        self.linear: tuple[bool, ...] = tuple(meta["linear"])
        self.constant: tuple[bool, ...] = tuple(meta["constant"])
        self._products: list[list[int]] = meta["products"]
        self.touched: tuple[int, ...] = tuple(meta["touched"])
        self.moves_sensors: bool = meta["moves_sensors"]
        self.moved_by: tuple[int, ...] = tuple(meta["moved_by"])
        self.driven: bool = meta["driven"]
        self.force_fed: bool = meta["force_fed"]
        self.moved_first: Indices = np.array(meta["moved_first"], dtype=np.int64)
        self.compensated: tuple[int, ...] = tuple(meta["compensated"])
        self.delays: tuple[str, ...] = tuple(meta["delays"])
        self.braked: bool = meta["braked"]
        self.state_groups = tuple(StateGroup(**group) for group in meta["state_groups"])

    @property
    def has_free_delay(self) -> bool:
        """Whether a delay is estimated, of one measured force or of all."""
        return bool(self._delayed)

    @property
    def takes_timing(self) -> bool:
        """Whether a delay of every measured force is estimated: that is the inputs' timing."""
        return self._delayed == {*self.model.device.forces}

    @cached_property
    def timing_effects(self) -> frozenset[str]:
        """Names of the effects that together delay every measured force; none if some stay."""
        late = {*self.delays}
        named = [e.name for e in self.model.effects if late & {p.name for p in e.parameters}]
        return frozenset(named if self.takes_timing else ())

    @cached_property
    def _delayed(self) -> set[str]:
        """The measured forces of which a delay is estimated."""
        device, results = self.model.device, set[str]()
        forces = dict(zip(device.components, device.forces, strict=True))
        for item in self.model.effects:
            if any(not p.fixed and p.name in self.delays for p in item.parameters):
                results |= {forces[item.target]} if item.target in forces else {*device.forces}
        return results

    @cached_property
    def parameters_by_force(self) -> frozenset[int]:
        """Numbers of the parameters of effects that alone change how a measured force acts."""
        return frozenset(k for own, alone in self._effects_on_force for k in own)

    @cached_property
    def filter_strengths(self) -> list[int]:
        """Numbers of the strengths of filters: a state follows the force, not in proportion."""
        return [
            k
            for own, alone in self._effects_on_force
            for k in own
            if alone.force_fed and self.parameters[k].strength and not self.linear[k]
        ]

    @cached_property
    def _effects_on_force(self) -> "list[tuple[list[int], System]]":
        """Each effect that changes how a force acts: numbers of its parameters, and it alone."""
        names, found = [q.name for q in self.parameters], list[tuple[list[int], System]]()
        for item in self.model.effects if self.driven or self.force_fed else ():
            if item.effect.has_play:
                continue
            alone = compile_model(Model(self.model.device, (item.name,), (item.effect,)))
            if alone.driven or alone.force_fed:
                found.append(([names.index(q.name) for q in item.parameters], alone))
        return found

    @cached_property
    def forced(self) -> tuple[int, ...]:
        """Columns of the inputs that hold a force or a time derivative of one."""
        orders = range(len(INPUT_ORDERS))
        names = {derivative(f, k) for f in self.model.device.forces for k in orders}
        return tuple(i for i, name in enumerate(self.inputs) if name in names)

    @property
    def sign_widths(self) -> Array:
        """Speeds over which the signs of velocities are smoothed, (n_q,), rad/s or m/s."""
        return np.array([c.sign_width for c in self.model.device.coordinates])

    @property
    def prior(self) -> Array:
        """Prior values of the parameters, (n_p,)."""
        return np.array([p.prior for p in self.parameters])

    @property
    def undriven(self) -> tuple[str, ...]:
        """Coordinates that no measured force acts on, such as a pole that hangs on a cart."""
        n = len(self.coordinates)
        poses = np.linspace(0.1, 1.3, 3 * n).reshape(3, n)
        acting = np.abs(self.input_map(poses, np.ones((3, len(self.inputs))))).sum(axis=(0, 2))
        return tuple(c for c, some in zip(self.coordinates, acting, strict=True) if some == 0.0)

    def is_linear_in(self, parameters: Sequence[int]) -> bool:
        """Whether the residual is linear in ``parameters``, by number, all together."""
        chosen = set(parameters)
        one_by_one = all(self.linear[i] for i in chosen)
        return one_by_one and not any(chosen.issuperset(pair) for pair in self._products)

    def by_name(self, p: Array) -> dict[str, float]:
        """The parameters ``p`` (n_p,) by name."""
        return {q.name: float(value) for q, value in zip(self.parameters, p, strict=True)}

    def index(self, name: str) -> int:
        """Position of the parameter called ``name``.

        Raises:
            KeyError: there is none.
        """
        return {p.name: i for i, p in enumerate(self.parameters)}[name]

    @cached_property
    def _arrays(self) -> ModuleType:
        return self._code.module("columns")

    @cached_property
    def _whole(self) -> generated_code.Generated:
        """Functions of the whole mechanism, which most candidates of a diagnosis never need."""

        def generate() -> "Generation":
            from bampipe.physics.model_code import whole_code

            return whole_code(self.model)

        return generated_code.load(f"{self.model.key}_whole", generate)

    @cached_property
    def _dynamics(self) -> ModuleType:
        return self._whole.module("dynamics")

    derivative = _compiled("derivative")
    """f(x, u, p, w, dx): numba-compiled state derivative (eq 14)."""
    measure = _compiled("measure")
    """h(x, u, p, y): numba-compiled encoder readings, positions then rates."""
    derivative_rows = _compiled("derivative_rows")
    """f(count, x, u, p, w, dx): `derivative` of many states at once, in vector registers.

    Quantity i of row r is at ``[i*ROWS + r]``; equal to `derivative` but for rounding.
    """
    measure_rows = _compiled("measure_rows")
    """h(count, x, u, p, y): `measure` of many states at once; see `derivative_rows`."""
    _residual = _compiled("residual")

    def encoder_readings(self, x: Array, u: Array, p: Array) -> Array:
        """Return encoder readings of states ``x`` (T, n_x): positions, then rates, (T, 2 n_q).

        Args:
            x: states, columns as in `states`; u: inputs, (T, n_u); p: parameters, (n_p,).
        """
        n = len(self.coordinates)
        if not self.moves_sensors:
            return x[:, : 2 * n].copy()
        q, qd = x[:, :n].T, x[:, n : 2 * n].T
        return stack_columns(self._dynamics.readings(q, qd, u.T, p), len(x))

    def offset(self, q: Array, u: Array, p: Array) -> Array:
        """Return true minus measured position, (T, n_q), rad or m.

        Args:
            q: readings, (T, n_q); u: inputs, (T, n_u); p: parameters, (n_p,).
        """
        return stack_columns(self._arrays.offset(q.T, u.T, p), len(q))

    def required(self, q: Array, qd: Array, qdd: Array, z: Array, u: Array, p: Array) -> Array:
        """Generalised force that the user must supply for this motion.

        Inertia, Coriolis, gravity, friction, brakes and every effect of kind ``torque``; the
        inverse dynamics of the model.

        Args:
            q, qd, qdd: motion of the mechanism, (T, n_q), rad or m and derivatives; it is `offset`
                from the encoder readings.
            z: internal states, (T, n_z), from `memory`.
            u: inputs, (T, n_u), columns as in `inputs`.
            p: parameters, (n_p,).

        Returns:
            (T, n_q), N.m or N.
        """
        return stack_columns(self._dynamics.required(q.T, qd.T, qdd.T, z.T, u.T, p), len(q))

    def applied(self, q: Array, qd: Array, qdd: Array, z: Array, u: Array, p: Array) -> Array:
        """Generalised force of the measured input mapped to the joints (eq 19), (T, n_q).

        Arguments as in `required`; effects of kind ``input`` are included. The model's residual
        is ``applied - required``.
        """
        return stack_columns(self._arrays.applied(q.T, qd.T, qdd.T, z.T, u.T, p), len(q))

    def residual(
        self,
        q: Array,
        qd: Array,
        qdd: Array,
        z: Array,
        u: Array,
        p: Array,
        bodies: Array | None = None,
    ) -> Array:
        """``applied - required``, compiled; (T, n_q), N.m or N.

        Arguments as in `required`; ``bodies`` is the result of `body_forces` for the same, if
        known.
        """
        if bodies is None:
            bodies = self.body_forces(q, qd, qdd, p)
        arrays = [np.ascontiguousarray(x, dtype=np.float64) for x in (q, qd, qdd, bodies, z, u, p)]
        out = np.empty(arrays[0].shape)
        self._residual(*arrays, out)
        return out

    def body_forces(self, q: Array, qd: Array, qdd: Array, p: Array) -> Array:
        """Forces that a robot's bodies require along a motion, (T, joints); (T, 0) else.

        They depend only on the parameters of the bodies.
        """
        count = self._whole.facts["bodies"]
        out = np.empty((len(q), count))
        if count:
            arrays = [np.ascontiguousarray(x, dtype=np.float64) for x in (q, qd, qdd, p)]
            self._whole.module("bodies").bodies(*arrays, out)
        return out

    @cached_property
    def lasting(self) -> frozenset[int]:
        """Parameters, by number, whose slopes `slopes` gives: most of those in `constant`."""
        return frozenset(self._whole.facts["lasting"]) | self.of_bodies.keys()

    @cached_property
    def of_bodies(self) -> dict[int, int]:
        """Places of parameters among all inertial numbers of a robot's bodies, by number."""
        robot = self.model.device.robot
        place = {p.name: k for k, p in enumerate(robot.parameters)} if robot else {}
        return {i: place[self.parameters[i].name] for i in self._whole.facts["of_bodies"]}

    def slopes(self, wanted: Sequence[int], q: Array, qd: Array, qdd: Array, u: Array) -> Array:
        """Slopes of the residual by parameters on which they do not depend, (T, n_q, n_wanted).

        Args:
            wanted: numbers of parameters, all in `lasting`.
            q, qd, qdd, u: as in `residual`.
        """
        results = np.zeros((len(wanted), len(self.coordinates), len(q))).transpose(2, 1, 0)
        bodies = [(k, self.of_bodies[i]) for k, i in enumerate(wanted) if i in self.of_bodies]
        if len(bodies) < len(wanted):
            column = {i: k for k, i in enumerate(wanted)}
            written = self._whole.module("slopes").slopes(q.T, qd.T, qdd.T, u.T)
            for (i, axis), slope in zip(self._whole.facts["slopes"], written, strict=True):
                if i in column:
                    results[:, axis, column[i]] = slope
        if bodies:
            robot = self.model.device.robot
            assert robot is not None
            for first in range(0, len(q), _TOGETHER):
                part = slice(first, first + _TOGETHER)
                forces = robot.columns(q[part], qd[part], qdd[part])
                for k, number in bodies:
                    link, place = divmod(number, INERTIAL)
                    for axis, by_link in enumerate(forces):
                        results[part, axis, k] -= by_link[link][place]
        return results

    def contribution(self, q: Array, qd: Array, qdd: Array, z: Array, u: Array, p: Array) -> Array:
        """Return the effects' terms in the residual, beyond the bare device, (T, n_q).

        Arguments as in `required`. Effects of kind ``measurement`` change the motion instead; see
        `offset`. Columns of axes that no effect touches are zero.
        """
        columns = self._arrays.contribution(q.T, qd.T, qdd.T, z.T, u.T, p)
        return self._on_axes(self.touched, columns, len(q))

    def _on_axes(self, axes: Sequence[int], columns: Sequence[Any], rows: int) -> Array:
        """Columns of some axes as (rows, n_q), zero on the others."""
        out = np.zeros((rows, len(self.coordinates)))
        for axis, column in zip(axes, columns, strict=True):
            out[:, axis] = column
        return out

    def input_map(self, q: Array, u: Array | None = None, p: Array | None = None) -> Array:
        """d applied / d force of the device itself, (T, n_q, n_force).

        Args:
            q: positions, (T, n_q).
            u: inputs, (T, n_u); needed where a force acts through another input, such as a duty
                cycle through the supply voltage. Zeros by default.
            p: parameters, (n_p,); priors by default.
        """
        n = len(self.coordinates)
        u = np.zeros((len(q), len(self.inputs))) if u is None else u
        columns = self._arrays.input_map(q.T, u.T, self.prior if p is None else p)
        return stack_columns(columns, len(q)).reshape(len(q), n, -1)

    def least_force(
        self, q: Array, load: Array, u: Array | None = None, p: Array | None = None
    ) -> Array:
        """The forces of least norm that give generalised forces ``load`` (T, n_q), (T, n_force).

        Args:
            q, u, p: as for `input_map`.
        """
        map_ = self.input_map(q, u, p)
        if map_.shape[1] == map_.shape[2]:
            # About ten times as fast; there is no solution at a pose in which a force has no
            # effect.
            with suppress(np.linalg.LinAlgError):
                return np.asarray(np.linalg.solve(map_, load[..., None])[..., 0])
        return np.asarray(np.einsum("tfq,tq->tf", np.linalg.pinv(map_), load))

    def mass_matrix(self, q: Array, p: Array) -> Array:
        """Mass matrix (eq 13), (T, n_q, n_q), kg m2, kg m, kg."""
        n = len(self.coordinates)
        return stack_columns(self._dynamics.mass_matrix(q.T, p), len(q)).reshape(len(q), n, n)

    def compensation(self, q: Array, qd: Array, z: Array, u: Array, p: Array) -> Array:
        """Generalised force of the gravity compensator (eq 16), (T, n_q), N.m or N.

        Effects that change it (a carriage that lags) are included. Arguments as in `required`;
        columns of axes not in `compensated` are zero.
        """
        columns = self._arrays.compensation(q.T, qd.T, z.T, u.T, p)
        return self._on_axes(self.compensated, columns, len(q))

    def initial_memory(self, q: Array, qd: Array, u: Array, p: Array) -> Array:
        """Internal states (n_z,) at the start of a trial, from its first q, qd (n_q,), u (n_u,)."""
        return np.array([float(v) for v in self._arrays.initial_memory(q, qd, u, p)])

    def memory(
        self, q: Array, qd: Array, qdd: Array, u: Array, p: Array, t: Array,
        parts: Sequence[slice] = (slice(None),), known: dict[StateKey, Array] | None = None,
    ) -> Array:  # fmt: skip
        """Internal states along the motion of one trial, (T, n_z), and rates of change after them.

        Integrated in steps of fourth order, or exponential ones where its rate is linear in the
        state, along rates that are cubic between samples and inputs that are linear. Coupled states
        take shorter steps where a contact opens or closes. A command or channel that is switched
        holds until the sample that first shows its new value.

        Args:
            q, qd, qdd, u, p: as in `required`.
            t: time, (T,), s.
            parts: rows of each trial, where these are several one after the other.
            known: states along this very motion, of any model; those found are added.
        """
        out = np.empty((len(q), len(self.memory_names) + len(self.changes)))
        rows = [part.start or 0 for part in parts]
        start = q[rows].T, qd[rows].T, u[rows].T
        z0 = stack_columns(self._arrays.initial_memory(*start, p), len(rows))
        known = {} if known is None else known
        for group in self.state_groups:
            module, first = self._state_modules[group.module], z0[:, group.places]
            along = (q, qd, qdd, u, p, t)
            out[:, group.places] = group.integrate(module, along, first, self.inputs, parts, known)
        for column, place in enumerate(self.changes, len(self.memory_names)):
            for part in parts:
                out[part, column] = np.gradient(out[part, place], t[part])
        return out

    @cached_property
    def _state_modules(self) -> dict[str, ModuleType]:
        return {group.module: self._code.module(group.module) for group in self.state_groups}


def stack_columns(columns: Sequence[Any], rows: int) -> Array:
    """Return columns, some of them constants, as one (rows, n) array."""
    out = np.empty((rows, len(columns)))
    for i, column in enumerate(columns):
        out[:, i] = column
    return out


def compile_model(model: Model) -> System:
    """The system of ``model``, derived and printed once, then read from the cache.

    Raises:
        InputError: an expression of the model is wrong, or the cache cannot be used.
    """

    def generate() -> "Generation":
        from bampipe.physics.model_code import effects_code

        return effects_code(model)

    return System(model, generated_code.load(model.key, generate))
