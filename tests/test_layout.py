"""The layout of src/gsgan: few entries, imports that point one way, one statement per value."""

import ast
import re
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "src" / "gsgan"
# Parts of the method, in reading order: each imports only from earlier ones.
PARTS = (
    "utils",
    "weights",
    "scene",
    "skeleton",
    "splat",
    "body",
    "effects",
    "model",
    "data",
    "motion",
    "synthetic",
    "losses",
    "metrics",
    "run",
)
ENTRIES = 28
# lines at most; a file of one purpose is not split to be shorter
FILES = sorted(PACKAGE.rglob("*.py"))


def module_name(path: Path) -> str:
    """``gsgan.data.layout`` of src/gsgan/data/layout.py."""
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path) for path in FILES}


def imported(path: Path, typing: bool = False) -> Iterator[str]:
    """Modules of gsgan that a file imports when it runs; with ``typing`` also for its types."""
    pending: list[ast.AST] = [ast.parse(path.read_text())]
    while pending:
        node = pending.pop()
        if (
            isinstance(node, ast.If)
            and "TYPE_CHECKING" in ast.unparse(node.test)
            and not typing
        ):
            continue
        if isinstance(node, ast.Import):
            yield from (
                alias.name for alias in node.names if alias.name in MODULES
            )
        elif isinstance(node, ast.ImportFrom) and node.module in MODULES:
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            yield from (names & MODULES) or {node.module}
        pending.extend(ast.iter_child_nodes(node))


def test_few_entries():
    entries = [
        p.name
        for p in PACKAGE.iterdir()
        if p.name not in ("__pycache__", "conf")
    ]
    assert len(entries) <= ENTRIES, sorted(entries)


def packed(node: ast.AST) -> bool:
    """Whether an assignment gives several names unrelated values; a swap does not."""
    if not isinstance(node, ast.Assign) or not isinstance(
        node.targets[0], ast.Tuple
    ):
        return False
    if isinstance(node.value, ast.GeneratorExp):
        return True
    if not isinstance(node.value, ast.Tuple):
        return False
    left = {ast.unparse(target) for target in node.targets[0].elts}
    right = {ast.unparse(value) for value in node.value.elts}
    return not left & right


def test_one_statement_per_value():
    assignments = []
    offenders = []
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Assign):
                assignments.append(node)
            if packed(node):
                offenders.append(f"{module_name(path)}:{node.lineno}")
    assert len(offenders) <= 0.01 * len(assignments), offenders


@pytest.mark.parametrize("part", PARTS)
def test_a_part_imports_only_earlier_parts(part):
    allowed = PARTS[: PARTS.index(part) + 1]
    for path in FILES:
        name = module_name(path).split(".")
        if name[1:2] != [part]:
            continue
        for other in imported(path):
            package = [*other.split("."), ""][1]
            assert package in ("", *allowed), (
                f"{'.'.join(name)} imports {other}"
            )


def test_no_circles():
    with_types = {
        module_name(path): set(imported(path, typing=True)) for path in FILES
    }
    TopologicalSorter(with_types).prepare()  # raises CycleError
    modules = {module_name(path): set(imported(path)) for path in FILES}
    packages: dict[str, set[str]] = {}
    for module, others in modules.items():
        package = module.split(".")[1:2]
        if package:
            found = {other.split(".")[1] for other in others if "." in other}
            packages.setdefault(package[0], set()).update(found - set(package))
    TopologicalSorter(packages).prepare()
    assert "export" not in packages["view"]


def test_the_page_has_the_parts_in_their_order():
    page = (PACKAGE.parents[1] / "docs" / "architecture.md").read_text()
    rows = [
        line.split("|")[1]
        for line in page.splitlines()
        if line.startswith("| `")
    ]
    named = [
        name for row in rows for name in re.findall(r"`(\w+)(?:/|\.py)`", row)
    ]
    assert [name for name in named if name in PARTS] == list(PARTS)


def test_no_public_class_name_is_defined_twice():
    names = []
    for path in FILES:
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                names.append(node.name)
    twice = {name for name in names if names.count(name) > 1}
    assert not twice


PARTICIPLES = frozenset(
    [
        "begun",
        "bent",
        "bound",
        "bought",
        "broken",
        "brought",
        "built",
        "caught",
        "chosen",
        "drawn",
        "driven",
        "done",
        "fallen",
        "found",
        "given",
        "gone",
        "grown",
        "had",
        "held",
        "hidden",
        "kept",
        "known",
        "laid",
        "left",
        "lent",
        "lost",
        "made",
        "met",
        "paid",
        "said",
        "seen",
        "sent",
        "shown",
        "shrunk",
        "swept",
        "taken",
        "thrown",
        "told",
        "torn",
        "turned",
        "won",
        "worn",
        "written",
    ]
)
# verbs and nouns that end as participles do
NO_PARTICIPLES = ("bed", "embed", "feed", "need", "seed", "shed", "speed")


def is_participle(name: str) -> bool:
    """Whether a function's first word is a participle."""
    first = name.strip("_").lower().split("_")[0]
    regular = first.endswith("ed") and first not in NO_PARTICIPLES
    return regular or first in PARTICIPLES


def test_functions_are_verbs():
    """Properties are left out: their names say what something is."""
    count = 0
    participles = []
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            decorators = " ".join(map(ast.unparse, node.decorator_list))
            if "property" in decorators or "overload" in decorators:
                continue
            count += 1
            if is_participle(node.name):
                participles.append(f"{module_name(path)}.{node.name}")
    assert len(participles) <= 0.02 * count, participles


def test_values_are_named_by_their_content():
    """Not by how they came about: see the table of words in CONTRIBUTING.md."""
    offenders = []
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                name = node.id
            elif isinstance(node, ast.arg | ast.FunctionDef):
                name = node.arg if isinstance(node, ast.arg) else node.name
            else:
                continue
            if name in ("found", "known", "own"):
                offenders.append(f"{module_name(path)}:{node.lineno} {name}")
    assert not offenders


def annotations(node: ast.FunctionDef | ast.AsyncFunctionDef) -> list[str]:
    """The types of a function's arguments."""
    arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    types = [argument.annotation for argument in arguments]
    return [ast.unparse(kind) for kind in types if kind is not None]


def test_configs_end_at_the_door():
    """A command's options are read from its config once; values travel on."""
    takers = []
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            if any("DictConfig" in kind for kind in annotations(node)):
                takers.append(f"{module_name(path)}.{node.name}")
    assert len(takers) <= 12, takers
