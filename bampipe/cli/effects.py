"""``bampipe effects``: the library, and one effect in full."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bampipe.cli import show
from bampipe.cli.device import check_effect_file
from bampipe.cli.options import RUNS, JsonOption, RunsOption
from bampipe.errors import InputError, choose_from

if TYPE_CHECKING:
    from bampipe.physics.effect import Effect

COLUMNS, ROWS = 61, 13


def effects(
    name: Annotated[
        str | None,
        typer.Argument(help="An effect, name[:target], or an effect file; or check, or adopt."),
    ] = None,
    file: Annotated[
        str | None, typer.Argument(metavar="[FILE]", help="After check or adopt: the effect file.")
    ] = None,
    device: Annotated[
        str, typer.Option(help="Device the effect is shown or checked on; a name or a file.")
    ] = "bam",
    runs: RunsOption = RUNS,
    json: JsonOption = False,
) -> None:
    """List the effects a model can have; with a name, show one in full; check or adopt a file.

    An adopted file is copied beside the run folders, and every run there weighs it from then on.

    Example: bampipe effects

    Example: bampipe effects stribeck:yaw

    Example: bampipe effects check snag.toml --device rail.toml

    Example: bampipe effects adopt runs/2026-10-03_s01/models/base/drafts/snag_by_position.toml
    """
    if name in ("check", "adopt") and file is None:
        raise InputError("which effect file?", remedy=f"bampipe effects {name} FILE")
    if name == "check":
        check_effect_file(str(file), device, json)
    elif name == "adopt":
        from bampipe.api.loop import adopt_effect

        copy = adopt_effect(Path(str(file)), runs)
        if json:
            show.print_json({"file": str(copy)})
        else:
            show.say(f"{copy}: every run in {runs} weighs it from its next diagnosis on")
    elif file is not None:
        raise InputError(f"{file!r} is one argument too many", remedy="bampipe effects NAME")
    elif name is not None:
        show_one(name, device, json)
    else:
        from bampipe.physics import registry

        found = [registry.effect(name) for name in registry.effect_names()]
        if json:
            names = ("name", "scope", "kind", "summary")
            show.print_json([{name: getattr(e, name) for name in names} for e in found])
            return
        show.print_table(
            ["effect", "acts on", "kind", "summary"],
            [[e.name, e.scope.replace("_", " "), e.kind, e.summary] for e in found],
        )
        show.say("\none in full: bampipe effects NAME")


def show_one(text: str, device_name: str, json: bool) -> None:
    """Print the effect ``text``, ``name[:target]`` or ``file.toml[:target]``, in full."""
    from bampipe.declarations.files import read_device, read_effect
    from bampipe.physics import registry

    name, _, target = text.partition(":")
    device = registry.device_from(*read_device(device_name))
    effect = registry.effect_from(read_effect(name), name)
    targets = effect.targets(device)
    if not targets:
        wanted = "a robot" if effect.robot else "one that can"
        raise InputError(
            f"device {device_name!r} cannot have effect {effect.name!r}",
            remedy=f"name {wanted}: bampipe effects {name} --device DEVICE.toml",
        )
    if target and target not in targets:
        raise InputError(
            f"effect {effect.name!r} has no target {target!r} on device {device_name!r}",
            remedy=choose_from(target, targets),
        )
    chosen = target or targets[0]

    from bampipe.diagnosis.signature import signature

    found = signature(device, effect, chosen)
    if json:
        shown = {"declaration": dict(effect.declaration), "targets": [t for t in targets if t]}
        about = found and {
            **{name: getattr(found, name) for name in ("axis", "unit", "against", "share")},
            "target": chosen,
            "rms": dict(found.rms),
        }
        show.print_json({**shown, "signature": about})
        return
    show.say(f"{effect.name}: {effect.summary}\n")
    for line in effect.formulas:
        show.say(f"  {line}")
    show.say("")
    rows = list(parameter_rows(effect))
    head = ["parameter", "axis", "unit", "prior", "sd", "lower", "upper", "typical", ""]
    used = [k for k in range(len(head)) if k < 1 or any(row[k] not in (None, "") for row in rows)]
    show.print_table([head[k] for k in used], [[row[k] for k in used] for row in rows])
    names = {item: f"{effect.name}:{item}".removesuffix(":") for item in targets}
    show.say(f"\non {device_name}: {', '.join(names.values())}")
    show.say(f"looks like: {effect.looks_like}")
    if effect.on_the_machine:
        show.say(f"on the machine: {effect.on_the_machine}")
    show.say(f"source: {effect.source}\n")
    title = names[chosen]
    if found is None:
        show.say(f"{title} leaves nothing in the residual of a free or braked motion")
        return
    brakes = ", brakes on" if found.braked else ""
    show.say(
        f"the residual of {title} on {found.axis} ({found.unit}) in a model without it, "
        f"against {found.against} ({found.against_unit}){brakes}:"
    )
    for line in plot(found.abscissa.tolist(), found.residual.tolist()):
        show.say(line)


def parameter_rows(effect: "Effect") -> Iterator[list[object]]:
    """Name, kind of axis, unit, numbers and description of each parameter."""
    from bampipe.physics.effect import ParameterByKind

    for name, entry in effect.parameters.items():
        if isinstance(entry, ParameterByKind):
            by_kind = {"rotary": entry.rotary, "linear": entry.linear}
        else:
            by_kind = {"": entry}
        for kind, p in by_kind.items():
            if p is not None:
                bounds = (value if math.isfinite(value) else None for value in (p.lower, p.upper))
                about = p.description or entry.description
                yield [name, kind, p.unit, p.prior, p.sd, *bounds, p.typical, about]


def plot(abscissa: Sequence[float], ordinate: Sequence[float]) -> list[str]:
    """Return a scatter plot in characters."""
    left, right = min(abscissa), max(abscissa)
    bottom, top = min(0.0, *ordinate), max(0.0, *ordinate)
    wide, high = (right - left) or 1.0, (top - bottom) or 1.0
    grid = [[" "] * COLUMNS for _ in range(ROWS)]
    zero = round((top - 0.0) / high * (ROWS - 1))
    grid[zero] = ["-"] * COLUMNS
    if left < 0.0 < right:
        column = round(-left / wide * (COLUMNS - 1))
        for row in grid:
            row[column] = "|"
        grid[zero][column] = "+"
    for x, y in zip(abscissa, ordinate, strict=True):
        grid[round((top - y) / high * (ROWS - 1))][round((x - left) / wide * (COLUMNS - 1))] = "•"
    labels = {0: f"{top:.3g}", zero: "0", ROWS - 1: f"{bottom:.3g}"}
    lines = [f"{labels.get(n, ''):>10} {''.join(row).rstrip()}" for n, row in enumerate(grid)]
    low, end = f"{left:.3g}", f"{right:.3g}"
    lines.append(f"{'':>10} {low}{end.rjust(COLUMNS - len(low))}")
    return lines
