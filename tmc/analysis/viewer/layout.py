"""Fill in `layout.json`, the template of the layout in which Lichtblick and Foxglove show a replay file.

In the template, an entry with `<id>` is repeated per UAV, with its `<colour>`; `<first>` is true for UAV 0 only.
`<x>`, `<y>` and `<height>` are the centre and the height of the view, `<cell>` is the width of a cell; all in metres.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from importlib.resources import files
from typing import Any

FILE = "layout.json"
"""The template's name in this package, and that of the attachment in a replay file."""
VIEW_HEIGHT_FACTOR = 1.1
"""Height of the view, relative to the longer side of the map."""
Values = Mapping[str, Any]


def layout(topics: Collection[str], colours: Sequence[str], rows: int, cols: int, cell_m: float) -> dict[str, Any]:
    """Return the layout for a file with these topics; other topics are left out.

    `colours`: one per UAV, `#RRGGBB`. `rows`, `cols`: of the grid. `cell_m`: width of a cell, metres.
    """
    height = VIEW_HEIGHT_FACTOR * max(rows, cols) * cell_m
    values = {"<x>": cols * cell_m / 2, "<y>": rows * cell_m / 2, "<height>": height, "<cell>": cell_m}
    uavs = [{"<id>": str(i), "<colour>": colour, "<first>": i == 0} for i, colour in enumerate(colours)]
    template = json.loads(files("tmc.analysis.viewer").joinpath(FILE).read_text("utf-8"))
    return dict(_kept(_filled(template, values, uavs), topics))


def topics_of(node: Any) -> Iterator[str]:
    """Yield every topic in a layout: a string that begins with a slash, without the field of its messages."""
    if isinstance(node, dict):
        node = [*node.keys(), *node.values()]
    if isinstance(node, list):
        for item in node:
            yield from topics_of(item)
    elif isinstance(node, str) and node.startswith("/"):
        yield node.partition(".")[0]


def _filled(node: Any, values: Values, uavs: Sequence[Values]) -> Any:
    if isinstance(node, dict):
        return {
            _text(key, own): _filled(value, own, uavs)
            for key, value in node.items()
            for own in _owners(key, values, uavs)
        }
    if isinstance(node, list):
        return [_filled(item, own, uavs) for item in node for own in _owners(json.dumps(item), values, uavs)]
    if isinstance(node, str):
        return values[node] if node in values else _text(node, values)
    return node


def _owners(text: str, values: Values, uavs: Sequence[Values]) -> list[Values]:
    """Return the values of each entry that an entry of the template becomes."""
    return [{**values, **uav} for uav in uavs] if "<id>" in text and "<id>" not in values else [values]


def _text(text: str, values: Values) -> str:
    for name in ("<id>", "<colour>"):
        text = text.replace(name, str(values.get(name, name)))
    return text


def _kept(node: Any, topics: Collection[str]) -> Any:
    """Return the layout without the entries that name a missing topic."""
    if isinstance(node, dict):
        return {key: _kept(value, topics) for key, value in node.items() if set(topics_of(key)) <= set(topics)}
    if isinstance(node, list):
        return [_kept(item, topics) for item in node if set(topics_of(item)) <= set(topics)]
    return node
