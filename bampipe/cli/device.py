"""``bampipe device``: devices, their equations of motion, and device files checked."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from bampipe.cli import show
from bampipe.cli.options import JsonOption
from bampipe.errors import InputError

SUMMARY = "List devices, show their equations of motion, and check device files."
app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help=f"{SUMMARY}\n\nExample: bampipe device check rail.toml",
)


def summary_of(command: Callable[..., None]) -> str:
    """Return the first line of a command's help: typer itself cuts it short in lists."""
    return (command.__doc__ or "").partition("\n")[0]


def list_(json: JsonOption = False) -> None:
    """List the built-in devices.

    Example: bampipe device list
    """
    from bampipe.physics import registry

    found = [registry.device(name) for name in registry.device_names()]
    rows = [
        {"name": d.name, "axes": [c.name for c in d.coordinates], "summary": d.summary}
        for d in found
    ]
    if json:
        show.print_json(rows)
        return
    show.print_table(["device", "axes", "summary"], [[*row.values()] for row in rows])
    show.say("\none in full: bampipe device show NAME")


def show_(
    device: Annotated[str, typer.Argument(help="A built-in device, or a device file.")],
    json: JsonOption = False,
) -> None:
    """Show a device in full: equations of motion, numbers, inputs, the effects it can have.

    Example: bampipe device show slider
    """
    from bampipe.declarations.files import device_faults, read_device
    from bampipe.physics import registry

    declaration, where = read_device(device)
    equations, faults = device_faults(declaration, where)
    if not equations:
        _report_faults(faults)
    found = registry.device_from(declaration, where)
    names = [
        f"{effect.name}:{target}" if target else effect.name
        for effect in map(registry.effect, registry.effect_names())
        for target in effect.targets(found)
    ]
    inputs = [f"{name} ({found.force_unit or 'a pure number'})" for name in found.forces]
    inputs += [f"{name} (brake of {axis})" for axis, name in found.brakes.items()]
    inputs += [f"{name} ({unit or 'a pure number'})" for name, unit in found.channels.items()]
    if json:
        found_names = {"inputs": inputs, "effects": names, "faults": faults}
        lines = equations.splitlines()
        show.print_json({"declaration": dict(declaration), "equations": lines, **found_names})
        return
    show.say(equations)
    show.say(f"inputs: {', '.join(inputs) or 'none'}")
    show.say(f"effects it can have: {', '.join(names) or 'none'}")
    _report_faults(faults)


def check(
    file: Annotated[str, typer.Argument(help="A device file, or the name of a built-in device.")],
    picture: Annotated[
        Path | None,
        typer.Option(
            help="For a robot: draw its joints and bodies into this SVG file.", metavar="FILE"
        ),
    ] = None,
    json: JsonOption = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Faults only.")] = False,
) -> None:
    """Check a device file, and print its equations of motion and its faults.

    Names, units, expressions and the derivation are checked. Exit 2 with one line a fault.

    Example: bampipe device check rail.toml

    Example: bampipe device check arm/device.toml --picture arm.svg
    """
    from bampipe.declarations.files import device_faults, read_device

    declaration, where = read_device(file)
    equations, faults = device_faults(declaration, where)
    if picture is not None and not faults:
        _draw(declaration, where, picture)
    if json:
        show.print_json({"file": where, "equations": equations.splitlines(), "faults": faults})
    elif equations and not quiet:
        show.say(equations)
    _report_faults(faults, json)
    if not quiet and not json:
        show.say(f"{where}: names, units and equations fit together")
        if picture is not None:
            show.say(f"wrote {picture}")
        show.print_advice(_advise_after_check(file))


def _draw(declaration: Mapping[str, Any], where: str, path: Path) -> None:
    """Write the picture of a robot, the only kind of device that has one."""
    from bampipe.declarations.robot_picture import draw_robot
    from bampipe.files import write_text
    from bampipe.physics import registry

    robot = registry.device_from(declaration, where).robot
    if robot is None:
        raise InputError("only robots are drawn", where=where, remedy="leave --picture out")
    if path.suffix.lower() != ".svg":
        raise InputError("expected a file name that ends in .svg", where=str(path))
    write_text(path, draw_robot(robot))


COMMANDS: dict[str, Callable[..., None]] = {"list": list_, "show": show_, "check": check}
for _name, _command in COMMANDS.items():
    app.command(_name, short_help=summary_of(_command))(_command)


def _advise_after_check(file: str) -> str:
    path = Path(file)
    if path.suffix != ".toml":
        return f'device = "{file}" in session.toml, then bampipe run SESSION'
    if (path.parent / "session.toml").is_file():
        return f"bampipe run {path.parent}"
    return f'put it into the folder of the logs, device = "{path.name}" in session.toml'


def _report_faults(faults: Sequence[str], json: bool = False) -> None:
    """Print faults on standard error, a line each, unless as ``json`` already; exit with 2."""
    for line in faults if not json else ():
        show.note(f"bampipe: error: {' '.join(line.split())}")
    if faults:
        raise typer.Exit(2)


def check_effect_file(text: str, device_name: str, json: bool) -> None:
    """Print the faults of the effect file ``text`` (``file.toml[:target]``), a line each.

    Raises:
        InputError: there is no such file or device.
        typer.Exit: something is wrong with it.
    """
    from bampipe.declarations.files import effect_faults, read_device, read_effect
    from bampipe.physics import registry

    file, _, target = text.partition(":")
    declaration, where = read_device(device_name)
    device = registry.device_from(declaration, where)
    tried, faults = effect_faults(read_effect(file), file, device, target)
    if json:
        show.print_json({"file": file, "device": device_name, "targets": tried, "faults": faults})
    _report_faults(faults, json)
    if not json:
        show.say(f"{file}: names and units fit on {device_name}, as {', '.join(tried)}")
        show.print_advice(f"bampipe effects {file}")
