"""Drawings of lines and texts on layers, in millimetres, as SVG and as DXF.

Public names: `LayeredDrawing`, `write_svg`, `write_dxf`.

DXF is that of AutoCAD release 12 (AC1009): closed and open POLYLINEs and TEXT on named layers, with the units
in the header, which every CAD and CAM program reads.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from html import escape

import numpy as np

from handtouch.arrays import FloatArray

LAYERS = {
    "CUT": ("#c0392b", 1),
    "SHEET": ("#8a8a8a", 8),
    "ELECTRODES": ("#b8741a", 30),
    "TAILS": ("#b8741a", 40),
    "CONNECTOR": ("#1f6fb4", 5),
    "DIMENSIONS": ("#1a1a1a", 7),
    "TEXT": ("#1a1a1a", 7),
}
"""Colour in SVG and colour number in DXF of each layer."""
_FILLED = {"ELECTRODES", "TAILS", "CONNECTOR"}
_MARGIN_MM = 4.0


@dataclass
class LayeredDrawing:
    """Lines (layer, points (k, 2)) and texts (layer, x, y, height, text), in mm, y upwards.

    A line whose last point is its first is closed.
    """

    title: str
    lines: list[tuple[str, FloatArray]] = field(default_factory=list)
    texts: list[tuple[str, float, float, float, str]] = field(default_factory=list)

    def line(self, layer: str, points: object) -> None:
        """Add a line through points (k, 2)."""
        self.lines.append((layer, np.asarray(points, np.float64)))

    def text(self, layer: str, x: float, y: float, text: str, height: float = 1.6) -> None:
        """Add a text that begins at (x, y)."""
        self.texts.append((layer, x, y, height, text))

    def dimension(self, start: tuple[float, float], stop: tuple[float, float], text: str) -> None:
        """Add a dimension line between two points, with ticks at its ends."""
        one, other = np.array(start), np.array(stop)
        along = (other - one) / np.hypot(*(other - one))
        tick = 0.6 * np.array([along[0] - along[1], along[0] + along[1]])
        for points in ([one, other], [one - tick, one + tick], [other - tick, other + tick]):
            self.line("DIMENSIONS", points)
        middle = (one + other) / 2 + (0.5 if along[0] else 0.8) * np.array([along[1], abs(along[0])])
        self.text("DIMENSIONS", float(middle[0]), float(middle[1]), text)

    @property
    def box(self) -> tuple[float, float, float, float]:
        """Lowest and highest x and y of all lines, with room for the texts."""
        points = np.concatenate([line for _, line in self.lines])
        right = max((x + 0.62 * height * len(text) for _, x, _, height, text in self.texts), default=-np.inf)
        low_y = min((y for _, _, y, _, _ in self.texts), default=np.inf)
        (x0, y0), (x1, y1) = points.min(axis=0), points.max(axis=0)
        return float(x0), float(min(y0, low_y)), float(max(x1, right)), float(y1)


def write_svg(drawing: LayeredDrawing) -> str:
    """Return the drawing as SVG, 1 unit = 1 mm, a group for each layer."""
    x0, y0, x1, y1 = drawing.box
    width, height = x1 - x0 + 2 * _MARGIN_MM, y1 - y0 + 2 * _MARGIN_MM
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.2f}mm" height="{height:.2f}mm" '
        f'viewBox="0 0 {width:.3f} {height:.3f}" font-family="sans-serif">',
        f"<title>{escape(drawing.title)}</title>",
        '<rect width="100%" height="100%" fill="white"/>',
    ]
    shift_x, shift_y = _MARGIN_MM - x0, _MARGIN_MM + y1
    for layer, (colour, _) in LAYERS.items():
        parts.append(f'<g id="{layer}" stroke="{colour}" stroke-width="0.15" fill="none">')
        for own, points in drawing.lines:
            if own == layer:
                way = " L".join(f"{shift_x + x:.3f} {shift_y - y:.3f}" for x, y in points)
                closed = _is_closed(points)
                fill = f' fill="{colour}" fill-opacity="0.35"' if closed and layer in _FILLED else ""
                parts.append(f'<path d="M{way}{" Z" if closed else ""}"{fill}/>')
        parts += [
            f'<text x="{shift_x + x:.3f}" y="{shift_y - y:.3f}" font-size="{size:g}" fill="{colour}" '
            f'stroke="none">{escape(text)}</text>'
            for own, x, y, size, text in drawing.texts
            if own == layer
        ]
        parts.append("</g>")
    return "\n".join([*parts, "</svg>", ""])


def write_dxf(drawing: LayeredDrawing) -> str:
    """Return the drawing as DXF of release 12, in millimetres."""
    x0, y0, x1, y1 = drawing.box
    tags: list[tuple[int, object]] = [(999, drawing.title), (0, "SECTION"), (2, "HEADER")]
    tags += [(9, "$ACADVER"), (1, "AC1009"), (9, "$INSUNITS"), (70, 4), (9, "$MEASUREMENT"), (70, 1)]
    tags += [(9, "$EXTMIN"), (10, x0), (20, y0), (30, 0.0), (9, "$EXTMAX"), (10, x1), (20, y1), (30, 0.0)]
    tags += [(0, "ENDSEC"), (0, "SECTION"), (2, "TABLES")]
    tags += [(0, "TABLE"), (2, "LTYPE"), (70, 1), (0, "LTYPE"), (2, "CONTINUOUS"), (70, 0)]
    tags += [(3, "Solid line"), (72, 65), (73, 0), (40, 0.0), (0, "ENDTAB")]
    tags += [(0, "TABLE"), (2, "LAYER"), (70, len(LAYERS))]
    for layer, (_, number) in LAYERS.items():
        tags += [(0, "LAYER"), (2, layer), (70, 0), (62, number), (6, "CONTINUOUS")]
    tags += [(0, "ENDTAB"), (0, "ENDSEC"), (0, "SECTION"), (2, "ENTITIES")]
    for layer, points in drawing.lines:
        closed = _is_closed(points)
        tags += [(0, "POLYLINE"), (8, layer), (66, 1), (70, int(closed)), (10, 0.0), (20, 0.0), (30, 0.0)]
        for x, y in points[:-1] if closed else points:
            tags += [(0, "VERTEX"), (8, layer), (10, float(x)), (20, float(y)), (30, 0.0)]
        tags += [(0, "SEQEND"), (8, layer)]
    for layer, x, y, height, text in drawing.texts:
        tags += [(0, "TEXT"), (8, layer), (10, x), (20, y), (30, 0.0), (40, height), (1, text)]
    tags += [(0, "ENDSEC"), (0, "EOF")]
    return "".join(f"{code:3d}\n{_format(value)}\n" for code, value in tags)


def _is_closed(points: FloatArray) -> bool:
    return len(points) > 2 and bool(np.allclose(points[0], points[-1], atol=1e-9))


def _format(value: object) -> str:
    text = f"{value:.6f}" if isinstance(value, float) else str(value)
    return text.encode("ascii", "replace").decode()
