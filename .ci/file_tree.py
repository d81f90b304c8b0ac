"""The file tree of README.md: one line a file, from the first line of each module's docstring.

python .ci/file_tree.py          # print it
python .ci/file_tree.py --write  # put it into README.md, between its two markers
"""

import ast
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("tron", "datagen", "train", "eval")
LONGEST = 80
BEGIN, END = "<!-- file tree: make format -->\n", "<!-- end of the file tree -->\n"


def tree() -> str:
    """Every folder and module of the packages, indented by depth, with its summary."""
    lines: list[str] = []
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py"), key=_order):
            depth = len(path.relative_to(ROOT).parts) - 1
            if path.name == "__init__.py":
                lines.append(f"{'  ' * (depth - 1)}{path.parent.name}/".ljust(32) + _summary(path))
            else:
                lines.append(f"{'  ' * depth}{path.name}".ljust(32) + _summary(path))
    return "```\n" + "\n".join(line.rstrip() for line in lines) + "\n```\n"


def _order(path: Path) -> tuple[tuple[int, str], ...]:
    """Modules of a folder before its subfolders, and `__init__` first of all."""
    *folders, name = path.relative_to(ROOT).parts
    return (*((1, folder) for folder in folders), (0, "" if name == "__init__.py" else name))


def _summary(path: Path) -> str:
    """The first line of a module's docstring, or what stands before its colon where the line is long."""
    text = (ast.get_docstring(ast.parse(path.read_text("utf-8"))) or "").partition("\n")[0].strip()
    whole = text.endswith(".") and len(text) <= LONGEST
    return (text if whole else text.partition(": ")[0]).removesuffix(".").removesuffix(":")


def written(readme: str) -> str:
    """README.md's text with the tree of today."""
    before, _, rest = readme.partition(BEGIN)
    return before + BEGIN + tree() + END + rest.partition(END)[2]


if __name__ == "__main__":
    if "--write" in sys.argv:
        readme = ROOT / "README.md"
        readme.write_text(written(readme.read_text("utf-8")), "utf-8")
    else:
        print(tree(), end="")
