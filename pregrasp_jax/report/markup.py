"""HTML and SVG from nested calls. Text is escaped unless it is `Markup`, so no name or setting can break a page."""

import html
import re
from collections.abc import Iterable

_VOID = frozenset({"br", "col", "img", "meta"})
"""Elements without content or end tag."""


class Markup(str):
    """Text that is HTML already."""

    __slots__ = ()


def element(name: str, /, *children: str, **attributes: str | float | None) -> Markup:
    """Return one element.

    Args:
        name: of the element.
        children: text, which is escaped, or `Markup`.
        attributes: `class_` is written class, `aria_label` aria-label; None leaves the attribute out.
    """
    written = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{html.escape(number(value))}"'
        for key, value in attributes.items()
        if value is not None
    )
    if name in _VOID:
        assert not children, f"<{name}> has no content"
        return Markup(f"<{name}{written}>")
    return Markup(f"<{name}{written}>{join(children)}</{name}>")


def join(parts: Iterable[str], separator: str = "") -> Markup:
    """Return parts one after the other; those that are not `Markup` are escaped."""
    return Markup(separator.join(part if isinstance(part, Markup) else html.escape(part) for part in parts))


def code(text: str) -> Markup:
    """Return text in code type whose long words may break at slashes, dots and underscores."""
    breakable = re.sub(r"([/._=])", "\\1\0", text)
    return element("code", Markup(html.escape(breakable).replace("\0", "<wbr>")))


def number(value: str | float) -> str:
    """Return a number without superfluous digits (a hundredth of a pixel is enough), text as it is."""
    if isinstance(value, str):
        return value
    return f"{value:.2f}".rstrip("0").rstrip(".") if isinstance(value, float) else str(value)
