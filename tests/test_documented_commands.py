"""Every command that the documents show: it exists, takes what it is given, prints what is shown.

A block of the kind console is run, page by page in order, in a folder of its own with the sample
sessions in it; a block of TOML that starts with a comment ``# NAME`` is that file. What is printed
has to be what is shown, numbers within 2 % or their last digit; ``…`` stands for anything, on a
line of its own for any lines. After ``<!-- takes minutes -->`` a block is run only where
BAMPIPE_DOCUMENTS=all.
"""

import ast
import os
import re
import runpy
import shlex
from collections.abc import Iterator
from decimal import Decimal
from pathlib import Path

import pytest
from conftest import Command

from bampipe.cli.one_stage import parse_settings
from bampipe.run.state import configure
from bampipe.stages import base

ROOT = Path(__file__).parent.parent
REFERENCE = runpy.run_path(str(ROOT / ".ci" / "reference.py"))
COMMANDS = REFERENCE["all_commands"]()
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "sample_runs/README.md")),
    *sorted((ROOT / "docs").glob("*.md")),
]
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]
FENCE = re.compile(
    r"^(?P<minutes><!-- takes minutes -->\n)?(?P<indent> *)```(?P<kind>\w*)\n(?P<text>.*?)^ *```$",
    re.M | re.S,
)
WORD = re.compile(r"[A-Z_]+")
TOLERANCE = 0.02


def blocks(text: str) -> Iterator[tuple[str, str, bool]]:
    """Kind, content and whether it takes minutes, of every fenced block."""
    for found in FENCE.finditer(text):
        lines = [line.removeprefix(found["indent"]) for line in found["text"].splitlines()]
        yield found["kind"], "\n".join(lines), bool(found["minutes"])


def lines_of_commands(text: str) -> Iterator[str]:
    """Every line of a page that calls bampipe, from its blocks and from its sentences."""
    for kind, content, _ in blocks(text):
        if kind in ("sh", "console", "yaml"):
            for line in content.replace("\\\n", " ").splitlines():
                yield from re.findall(r"(?:^|[|;&] |run: )\s*(?:\$ )?(bampipe .*)", line)
    yield from re.findall(r"`(bampipe [^`]+)`", FENCE.sub("", text))


def check(line: str) -> None:
    """Assert that the command of ``line`` exists and takes its arguments; nothing is run."""
    line = re.sub(r"\$\{\w+:-(\w+)\}", r"\1", line)
    words = shlex.split(re.split(r" [|>;&]+ ", line)[0], comments=True)
    if WORD.fullmatch(words[1]):
        return  # STAGE or COMMAND, whichever
    if words[1:] in (["--version"], ["--help"]):
        return
    name, given = " ".join(words[:2]), words[2:]
    if name not in COMMANDS:
        name, given = " ".join(words[:3]), words[3:]
    command = COMMANDS[name]
    try:
        context = command.make_context(name, [word for word in given if word != "--help"])
    except Exception as error:
        # A sentence may leave out what a command or an option needs, but give nothing unknown.
        left_out = type(error).__name__ == "MissingParameter"
        assert left_out or "requires an argument" in str(error), f"{line}: {error}"
        return
    stage = name.removeprefix("bampipe ")
    for key, value in parse_settings(context.params.get("settings")).items():
        if stage == "run":
            configure(key.partition(".")[0], {key.partition(".")[2]: value})
        elif stage in base.STAGES:
            configure(stage, {key: value})
    for word in given:
        if word.startswith(("sample_runs/", "benchmarks/", "bampipe/", "docs/")):
            assert "NAME" in word or (ROOT / word).exists(), f"{line}: there is no {word}"


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_commands_exist_and_take_their_arguments(page: Path) -> None:
    for line in lines_of_commands(page.read_text(encoding="utf-8")):
        check(line)


def options_of_script(script: Path) -> set[str]:
    """The options that a script declares, to argparse or to the parser that scripts share."""
    tree = ast.parse(script.read_text(encoding="utf-8"))
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    words = {a.value for c in calls for a in c.args if isinstance(a, ast.Constant)}
    shared = [c for c in calls if isinstance(c.func, ast.Name) and c.func.id == "parse"]
    if shared:
        words |= options_of_script(ROOT / "benchmarks" / "measured.py")
        words |= {f"--{k.arg}" for c in shared for k in c.keywords}
    return {word for word in words if isinstance(word, str) and word.startswith("--")}


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_scripts_exist_and_know_their_options(page: Path) -> None:
    for line in re.findall(r"python (benchmarks/[^`\n]*)", page.read_text(encoding="utf-8")):
        script, *given = shlex.split(line)
        options = {word.partition("=")[0] for word in given if word.startswith("--")}
        assert options <= options_of_script(ROOT / script), line


def test_examples_of_the_help_take_their_arguments() -> None:
    examples = re.findall(r"^(bampipe .*)$", REFERENCE["commands"](), re.M)
    assert len(examples) > len(COMMANDS)
    for line in examples:
        check(line)


@pytest.mark.parametrize(
    "line",
    [
        "bampipe rum SESSION",
        "bampipe run s --pipelin strict",
        "bampipe run s --set filter.band=3",
        "bampipe filter --set band_hz=wide",
        "bampipe run sample_runs/second",
    ],
)
def test_a_command_that_is_none_is_found(line: str) -> None:
    with pytest.raises(Exception, match=r"rum|pipelin|band|second"):
        check(line)


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_blocks_of_commands_say_so(page: Path) -> None:
    """What is indented or fenced without a kind is not looked at: no command may hide there."""
    text = page.read_text(encoding="utf-8")
    hidden = [c for kind, c, _ in blocks(text) if not kind and re.match(r"(\$ )?bampipe ", c)]
    assert hidden == []
    assert re.findall(r"^ {4,}(?:\$ )?bampipe .*", FENCE.sub("", text), re.M) == []


def pattern(shown: str) -> re.Pattern[str]:
    """What ``shown`` matches: blanks of any width, numbers as groups, ``…`` for the rest."""
    parts = []
    for line in shown.splitlines():
        if line.strip() == "…":
            parts.append(r"(?:.*\n)*?")
            continue
        pieces = re.split(
            r"(…|(?<![\w.])-?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.]\w)|\s+)", line.strip()
        )
        parts.append(r"\s*" + "".join(map(_piece, pieces)) + r"\s*\n")
    return re.compile(r"\s*" + "".join(parts))


def _piece(piece: str) -> str:
    if piece == "…":
        return ".*?"
    if not piece.strip():
        return r"\s+" if piece else ""
    if re.fullmatch(r"-?\d.*", piece):
        return r"(-?\d+(?:\.\d+)?(?:e[-+]?\d+)?)"
    return re.escape(piece)


def assert_printed(shown: str, printed: str) -> None:
    """Assert that ``printed`` is what is ``shown``."""
    found = pattern(shown).fullmatch(printed.rstrip() + "\n")
    assert found is not None, f"shown:\n{shown}\n\nprinted:\n{printed}"
    expected = pattern(shown).fullmatch(shown.rstrip() + "\n")
    for number, wanted in zip(found.groups(), expected.groups(), strict=True):
        last_digit = 10.0 ** Decimal(wanted).as_tuple().exponent
        tolerance = max(TOLERANCE * abs(float(wanted)), 1.01 * last_digit if "." in wanted else 0.0)
        assert abs(float(number) - float(wanted)) <= tolerance, f"{number}, not {wanted}: {printed}"


def test_what_is_printed_is_held_against_what_is_shown() -> None:
    printed = "a table\n  yaw  1.23  kg\n  pitch  4.56  kg\n\nnext: bampipe run\n"
    for shown in (printed, "a table\n…\nnext: bampipe run", "a table\n  yaw 1.22 …\n…"):
        assert_printed(shown, printed)
    for shown in ("a table\n  yaw 1.30 …\n…", "a table\n…\nnext: bampipe lab", "  yaw …\n…"):
        with pytest.raises(AssertionError):
            assert_printed(shown, printed)


RUN = [page for page in PAGES if any(k == "console" for k, *_ in blocks(page.read_text("utf-8")))]


@pytest.mark.long
@pytest.mark.parametrize("page", RUN, ids=lambda p: str(p.relative_to(ROOT)))
def test_a_page_prints_what_it_shows(
    page: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    command: Command,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sample_runs").symlink_to(ROOT / "sample_runs")
    everything = os.environ.get("BAMPIPE_DOCUMENTS") == "all"
    for kind, content, minutes in blocks(page.read_text(encoding="utf-8")):
        if kind == "toml" and (head := re.match(r"# ([\w/.-]+)\n", content)):
            path = tmp_path / head[1]
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(content)
        if kind != "console" or (minutes and not everything):
            continue
        for part in re.split(r"^\$ ", content, flags=re.M)[1:]:
            line, _, shown = part.replace("\\\n", " ").partition("\n")
            program, *arguments = shlex.split(line, comments=True)
            assert program == "bampipe", f"{line}: only bampipe is run"
            code, printed, errors = command(*arguments)
            failed = "error: " in shown
            assert code == (2 if failed else 0), f"{line}: exit code {code}\n{errors}"
            if shown.strip():
                assert_printed(shown, errors if failed else printed)
