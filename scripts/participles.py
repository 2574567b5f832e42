"""Counts the functions of a folder whose first word is a participle: ``participles.py [FOLDER]``.

Functions are named by a verb (`render_features`, not `_rendered`). Properties are left out, whose
names describe what they are.
"""

import ast
import re
import sys
from pathlib import Path

IRREGULAR = frozenset(
    """
    begun bent bound bought broken brought built caught chosen drawn driven done fallen felt
    found given gone grown had held hidden kept known laid left lent lost made meant met paid
    said seen sent shown shrunk sought swept taken thrown told torn thought turned understood
    worn won written
    """.split()  # noqa: SIM905
)
# verbs and nouns that end alike
NO_PARTICIPLES = ("bed", "embed", "feed", "need", "seed", "shed", "speed")


def is_participle(name: str) -> bool:
    """Whether a function's first word is a participle."""
    first = re.split("_", name.strip("_").lower())[0]
    regular = first.endswith("ed") and first not in NO_PARTICIPLES
    return regular or first in IRREGULAR


def main() -> None:
    """Lists the functions by file, then their number and share."""
    count = 0
    participles: list[str] = []
    for path in sorted(
        Path(sys.argv[1] if sys.argv[1:] else "src").rglob("*.py")
    ):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            decorators = " ".join(map(ast.unparse, node.decorator_list))
            if "property" in decorators or "overload" in decorators:
                continue
            count += 1
            if is_participle(node.name):
                participles.append(f"{path}:{node.lineno} {node.name}")
    print("\n".join(participles))
    print(
        f"{len(participles)} of {count} functions, {len(participles) / count:.1%}"
    )


if __name__ == "__main__":
    main()
