"""Whether a wheel and an sdist hold what they have to: `python .ci/check_package.py dist/*`."""

from __future__ import annotations

import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).parent.parent
LINKED = {"bampipe/_schemas": "schemas", "bampipe/_pipelines": "pipelines",
          "bampipe/_sample_runs": "sample_runs"}  # fmt: skip
BESIDE = {"LICENSE", "MANIFEST.in", "PKG-INFO", "README.md", "pyproject.toml", "setup.cfg"}
"""What an sdist has beside the package."""


def expected() -> set[str]:
    """The files of the package: those under version control, links followed."""
    listed = ["git", "-C", str(ROOT), "ls-files", "bampipe", *LINKED.values()]
    found = subprocess.run(listed, capture_output=True, text=True, check=True).stdout.split()
    homes = {folder: link for link, folder in LINKED.items()}
    package = set()
    for name in found:
        top, _, rest = name.partition("/")
        if name not in LINKED:
            package.add(f"{homes[top]}/{rest}" if top in homes else name)
    return package


def contents(path: Path) -> set[str]:
    """The files in a wheel or an sdist that are no metadata."""
    if path.suffix == ".whl":
        names = zipfile.ZipFile(path).namelist()
        return {name for name in names if ".dist-info/" not in name}
    with tarfile.open(path) as archive:
        names = [member.name.partition("/")[2] for member in archive if member.isfile()]
    return {name for name in names if ".egg-info/" not in name} - BESIDE


def main(paths: list[str]) -> int:
    """Print what is missing from each file, and what should not be there."""
    if sorted(Path(path).suffix for path in paths) != [".gz", ".whl"]:
        print("check_package.py: expected one wheel and one sdist", file=sys.stderr)
        return 2
    wrong = []
    for path in map(Path, paths):
        found, wanted = contents(path), expected()
        wrong += [f"{path.name} lacks {name}" for name in sorted(wanted - found)]
        wrong += [f"{path.name} should not hold {name}" for name in sorted(found - wanted)]
    print("\n".join(wrong) or f"package: {len(expected())} files, all of them in both")
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
