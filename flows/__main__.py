"""Names the commands: ``python -m flows``."""

import ast
from pathlib import Path

__all__ = ["doors"]


def doors() -> dict[str, str]:
    """The first line about every module here that is a command, by its name."""
    here = Path(__file__)
    modules = {path.stem: path for path in here.parent.glob("*.py") if path != here}
    modules |= {path.parent.name: path for path in here.parent.glob(f"*/{here.name}")}
    found = {}
    for name, path in sorted(modules.items()):
        source = path.read_text(encoding="utf-8")
        if '\nif __name__ == "__main__":\n' in source:
            about = ast.get_docstring(ast.parse(source)) or name
            found[name] = about.splitlines()[0].partition(": ``")[0].rstrip(".")
    return found


def main() -> None:
    """Print the commands."""
    print("usage: python -m flows.COMMAND [KEY=VALUE ...]; --help after any says more.\n")
    for name, about in doors().items():
        print(f"  {name:<16}{about}")


if __name__ == "__main__":
    main()
