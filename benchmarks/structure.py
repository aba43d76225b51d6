"""Measure the structure of a checkout: sizes, imports, and who knows what an action is.

Prints one JSON object about `pregrasp_jax` in FOLDER (default: the checkout of this file). Nothing of it is imported
or run, so any version can be measured, wherever its files lie. Every number counts something in the syntax tree:

* A *body* is a function without signature, decorators and docstring; one inside another counts for both.
* `imports` counts pairs of modules of which one imports the other, wherever the statement stands.
* `push_path` lists the modules through which a push passes from the policy to the loss: among the modules that define
  `make_iterate` (an iteration of a training) or `Env`, and all that these import, directly or not, those whose code has
  a name with one of the words action, aperture, choice and stroke. Command lines, reports and films are not reached.
* `decoding` and `encoding` are functions that turn an action's index into its parts or back: by a call of
  `decode_action` or `actions.decode(...)` (`encode` alike), or by hand, with `//`, `%`, `divmod` or `unravel_index` on
  a name with the word action, or as a sum of a product and an aperture or choice. `by_hand` lists the second kind once
  more. The module that defines the index (`decode_action` or `ActionSpace`) is left out.
* `two_valued` are functions that know how many apertures there are: NUM_ACTIONS, `GRID_SIZE * GRID_SIZE * 2`, an index
  ``[..., 0]``, ``[..., 1]`` or ``[..., aperture]`` of Q values, a coin for an aperture, two channels of a readout.
* `aperture_names` are functions that name CLOSED or OPEN, `aperture_comparisons` those that compare with them.
* `success_modules` name TARGET_IN_REGION or its string.

Flattening all Q values (`ravel`, `argmax`) is not counted: it is right for any number of choices.
"""

import argparse
import ast
import json
import re
import statistics
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

PACKAGE = "pregrasp_jax"

ENDS = {"make_iterate", "Env"}
"""Modules that define one of these are where `push_path` begins."""

INDEX = {"decode_action", "ActionSpace"}
"""The module that defines one of these may know the layout of an action."""

ACTION = {"action", "actions"}
CHOICE = {"aperture", "apertures", "choice", "choices"}
PUSH = ACTION | CHOICE | {"stroke", "strokes"}
Q_VALUES = {"q", "values"}

Rule = Callable[[ast.AST], bool]


@dataclass(frozen=True, kw_only=True)
class Module:
    """One file of the package.

    Attributes:
        name: dotted, without the package's own; that of its folder for an `__init__`.
        tree: its syntax.
        num_lines: of the file.
    """

    name: str
    tree: ast.Module
    num_lines: int

    @property
    def defined(self) -> set[str]:
        """Functions and classes at the top of the module."""
        return {node.name for node in self.tree.body if isinstance(node, (ast.FunctionDef, ast.ClassDef))}


def load(folder: Path) -> dict[str, Module]:
    """Return the modules of a checkout by name.

    Raises:
        ValueError: the folder holds no package, or a file is no Python.
    """
    package = folder / PACKAGE
    modules = {}
    for file in sorted(package.rglob("*.py")):
        parts = file.relative_to(package).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        text = file.read_text()
        try:
            modules[name] = Module(name=name, tree=ast.parse(text), num_lines=len(text.splitlines()))
        except SyntaxError as error:
            raise ValueError(f"{file} is no Python: {error}") from error
    if not modules:
        raise ValueError(f"{folder} has no modules in {PACKAGE}/; allowed is a checkout of the project")
    return modules


def imports(module: Module, known: dict[str, Module]) -> set[str]:
    """Return the modules of the package that a module imports, be it whole or something of them."""
    names = []
    for node in ast.walk(module.tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    inner = [name.removeprefix(f"{PACKAGE}.") for name in names if name.startswith(f"{PACKAGE}.")]
    return {name if name in known else name.rpartition(".")[0] for name in inner} & known.keys() - {module.name, ""}


def bodies(module: Module) -> Iterator[tuple[int, str]]:
    """Yield number of lines and name of every function's body."""
    for node in ast.walk(module.tree):
        if isinstance(node, ast.FunctionDef):
            statements = node.body[1:] if ast.get_docstring(node) is not None else node.body
            lines = (node.end_lineno or 0) - statements[0].lineno + 1 if statements else 0
            yield lines, f"{module.name}: {node.name}"


def push_path(modules: dict[str, Module], graph: dict[str, set[str]]) -> list[str]:
    """Return the modules through which a push passes, as the top of this file defines it."""
    reached = [name for name, module in modules.items() if module.defined & ENDS]
    for name in reached:  # grows while it is walked
        reached += graph[name] - set(reached)
    return sorted(name for name in reached if words(modules[name].tree) & PUSH)


def words(node: ast.AST) -> set[str]:
    """Return the words of all names in a node: `next_action` has two. A length and numpy's `choice` say nothing."""
    if isinstance(node, ast.Call) and is_named(node.func, {"len", "choice"}):
        return set()
    names = [getattr(node, field, None) for field in ("id", "attr", "arg", "name")]
    found = {word for name in names if isinstance(name, str) for word in name.lower().split("_")}
    return found.union(*map(words, ast.iter_child_nodes(node)))


def is_named(node: ast.AST, names: set[str]) -> bool:
    """Return whether a node is one of some names, qualified or not."""
    return (isinstance(node, ast.Name) and node.id in names) or (isinstance(node, ast.Attribute) and node.attr in names)


def is_call(node: ast.AST, names: set[str], about: set[str]) -> bool:
    """Return whether a node calls one of some functions and says one of the words `about` in doing so."""
    return isinstance(node, ast.Call) and is_named(node.func, names) and bool(words(node) & about)


def is_product(node: ast.AST) -> bool:
    """Return whether a node is a multiplication."""
    return isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult)


def decodes_by_hand(node: ast.AST) -> bool:
    """Return whether a node divides an action into its parts."""
    if isinstance(node, ast.BinOp):
        return isinstance(node.op, (ast.FloorDiv, ast.Mod)) and bool(words(node.left) & ACTION)
    return is_call(node, {"divmod", "unravel_index"}, ACTION)


def encodes_by_hand(node: ast.AST) -> bool:
    """Return whether a node adds an aperture to a multiple of something else."""
    if not (isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add)):
        return is_call(node, {"ravel_multi_index"}, CHOICE)
    sides = (node.left, node.right), (node.right, node.left)
    return any(is_product(a) and not words(a) & CHOICE and bool(words(b) & CHOICE) for a, b in sides)


def is_two_valued(node: ast.AST) -> bool:
    """Return whether a node relies on there being two apertures, or on their order."""
    if isinstance(node, ast.Subscript):
        ends = node.slice.elts if isinstance(node.slice, ast.Tuple) else []
        last = ends[-1] if ends and ast.unparse(ends[0]) == "..." else ast.Slice()
        known = isinstance(last, ast.Constant) and last.value in (0, 1)
        return bool(words(node.value) & Q_VALUES) and (known or bool(words(last) & CHOICE))
    if isinstance(node, ast.Call) and is_named(node.func, {"Conv", "Dense"}):
        return isinstance(node.args[0], ast.Constant) and node.args[0].value == 2 if node.args else False
    if is_product(node):
        factors = ast.unparse(node).split(" * ")
        return "2" in factors and sum(re.search(r"\bGRID_SIZE$", factor) is not None for factor in factors) == 2
    return is_named(node, {"NUM_ACTIONS"}) or is_call(node, {"bernoulli"}, CHOICE)


def names_aperture(node: ast.AST) -> bool:
    """Return whether a node is one of the two apertures by name."""
    return is_named(node, {"CLOSED", "OPEN"})


def compares_aperture(node: ast.AST) -> bool:
    """Return whether a node compares with one of the two apertures."""
    return isinstance(node, ast.Compare) and any(map(names_aperture, (node.left, *node.comparators)))


def names_success(node: ast.AST) -> bool:
    """Return whether a node is the reason for which today's episodes succeed."""
    return is_named(node, {"TARGET_IN_REGION"}) or (isinstance(node, ast.Constant) and node.value == "target_in_region")


def places(module: Module, rule: Rule) -> list[str]:
    """Return the innermost functions or classes in which a rule holds (or the module, outside of them), each once."""
    found = {}

    def visit(node: ast.AST, place: str) -> None:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            place = f"{place}.{node.name}" if ":" in place else f"{place}: {node.name}"
        if rule(node):
            found[place] = None
        for child in ast.iter_child_nodes(node):
            visit(child, place)

    visit(module.tree, module.name)
    return list(found)


def measure(folder: Path) -> dict[str, object]:
    """Return all numbers about a checkout.

    Raises:
        ValueError: see `load`.
    """
    modules = load(folder)
    graph = {name: imports(module, modules) for name, module in modules.items()}
    path = push_path(modules, graph)
    sizes = [(module.num_lines, name) for name, module in modules.items()]
    lengths = [body for module in modules.values() for body in bodies(module)]
    users = [module for module in modules.values() if not module.defined & INDEX]

    def everywhere(rule: Rule, searched: list[Module] = users) -> list[str]:
        return [place for module in searched for place in places(module, rule)]

    def codecs(verb: str, by_hand: Rule) -> dict[str, list[str]]:
        def rule(node: ast.AST) -> bool:
            return is_call(node, {f"{verb}_action", verb}, ACTION) or by_hand(node)

        on_path = everywhere(rule, [module for module in users if module.name in path])
        elsewhere = everywhere(rule, [module for module in users if module.name not in path])
        return {"on_push_path": on_path, "elsewhere": elsewhere, "by_hand": everywhere(by_hand)}

    return {
        "modules": len(modules),
        "module_lines_median": statistics.median(lines for lines, _ in sizes),
        "module_lines_max": max(sizes),
        "functions": len(lengths),
        "body_lines_median": statistics.median(lines for lines, _ in lengths),
        "body_lines_max": max(lengths),
        "imports": sum(map(len, graph.values())),
        "push_path": path,
        "decoding": codecs("decode", decodes_by_hand),
        "encoding": codecs("encode", encodes_by_hand),
        "two_valued": everywhere(is_two_valued),
        "aperture_names": everywhere(names_aperture),
        "aperture_comparisons": everywhere(compares_aperture),
        "success_modules": [module.name for module in modules.values() if places(module, names_success)],
    }


def main() -> None:
    """Print the numbers about the folder that was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, default=Path(__file__).parent.parent, help="a checkout")
    try:
        print(json.dumps(measure(parser.parse_args().folder), indent=2))
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
