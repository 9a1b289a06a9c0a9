"""Names the commands: ``python -m flows``."""

import ast
from pathlib import Path

__all__ = ["doors"]


def doors() -> dict[str, str]:
    """The first line about every module here that is a command, by its name."""
    found = {}
    for path in sorted(Path(__file__).parent.glob("*.py")):
        source = path.read_text(encoding="utf-8")
        if path.name != Path(__file__).name and '\nif __name__ == "__main__":\n' in source:
            about = ast.get_docstring(ast.parse(source)) or path.stem
            found[path.stem] = about.splitlines()[0].partition(": ``")[0].rstrip(".")
    return found


def main() -> None:
    """Print the commands."""
    print("usage: python -m flows.COMMAND [KEY=VALUE ...]; --help after any says more.\n")
    for name, about in doors().items():
        print(f"  {name:<16}{about}")


if __name__ == "__main__":
    main()
