"""YAML as this package reads and writes it: plain data by the core schema of YAML 1.2, in which no key stands twice.

PyYAML by itself follows YAML 1.1, in which `1e-3` is text, `010` is eight and `yes` is true, and of two equal keys it
takes the last in silence. Aliases are refused: nested ones can stand for more data than fits into memory.
"""

import re
from pathlib import Path
from typing import Any

import yaml

from pregrasp_jax.messages import one_line

_END = re.compile(rb"\n---\s*\Z")
"""Begins a document that holds nothing: how ROS ends what it prints."""

_CORE_SCHEMA = {
    "null": (r"~|null|Null|NULL|", "~nN"),
    "bool": (r"true|True|TRUE|false|False|FALSE", "tTfF"),
    "int": (r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+", "-+0123456789"),
    "float": (
        r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        "-+.0123456789",
    ),
}
"""Kind of a plain scalar -> what it looks like, and the characters with which it begins."""


def read(path: Path) -> Any:
    """Return what a YAML file holds.

    Raises:
        ValueError: the file cannot be read, is not YAML, or names a key twice; one line says where.
    """
    try:
        return yaml.load(_END.sub(b"\n", path.read_bytes()), _Loader)
    except yaml.MarkedYAMLError as error:
        said = ", ".join(filter(None, (error.context, error.problem)))
        raise ValueError(f"{path}: {_place(error)}{one_line(said)}") from None
    except yaml.YAMLError as error:
        raise ValueError(f"{path}: not valid YAML: {one_line(error)}") from None
    except RecursionError:
        raise ValueError(f"{path}: nested too deeply; allowed are mappings of settings") from None
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, KeyError) as error:  # of a number with thousands of digits, of `!!bool maybe`
        raise ValueError(f"{path}: holds a value that cannot be read ({one_line(error)})") from None


def dump(values: Any) -> bytes:
    """Return plain data as YAML that `read` gives back, keys in their order."""
    return yaml.dump(values, Dumper=_Dumper, sort_keys=False).encode()


class _Loader(yaml.SafeLoader):
    """Knows plain data only, by the core schema."""

    yaml_constructors = {  # noqa: RUF012
        tag: make
        for tag, make in yaml.SafeLoader.yaml_constructors.items()
        if tag is None or tag.rpartition(":")[2] in {"map", "seq", "str", *_CORE_SCHEMA}
    }
    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012  (filled by `_use_core_schema`)

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            alias = self.peek_event()
            problem = f"alias *{alias.anchor}; allowed are values written out"
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=alias.start_mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        mapping = super().construct_mapping(node, deep)
        lines: dict[Any, int] = {}
        for key_node, _ in node.value:
            key, mark = self.construct_object(key_node, deep=True), key_node.start_mark
            if key in lines:
                problem = f"'{key}' stands here and in line {lines[key]}; allowed is one entry"
                raise yaml.MarkedYAMLError(problem=problem, problem_mark=mark)
            lines[key] = mark.line + 1
        return mapping

    def construct_int(self, node: Any) -> int:
        text = self.construct_scalar(node)
        return int(text, {"0o": 8, "0x": 16}.get(text[:2], 10))


class _Dumper(yaml.SafeDumper):
    """Quotes text that `_Loader` would take for something else."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012  (filled by `_use_core_schema`)


def _use_core_schema(cls: Any) -> None:
    for kind, (pattern, first) in _CORE_SCHEMA.items():
        letters = [*first, ""] if kind == "null" else list(first)
        cls.add_implicit_resolver(f"tag:yaml.org,2002:{kind}", re.compile(rf"^(?:{pattern})$"), letters)


_use_core_schema(_Loader)
_use_core_schema(_Dumper)
_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_int)


def _place(error: yaml.MarkedYAMLError) -> str:
    mark = error.problem_mark or error.context_mark
    return f"line {mark.line + 1}: " if mark else ""
