"""Wiring diagram of a sensor node: `python docs/wiring.py >docs/wiring.svg`, as `make wiring` does."""

from __future__ import annotations

from collections.abc import Sequence

WIDTH, TOP, HEIGHT = 980, 80, 560
ELECTRODES = ("x0", "xa", "y0", "yb")
FEEDBACK_OHM, FEEDBACK_NF, DRIVE_V = 240, 68, 5.0
INK, SHEET, ACCENT, GROUND, BOX = "#222", "#d9d2c5", "#b03a2e", "#1f618d", "#f4f6f7"
ROWS = (150, 230, 310, 390)  # y of the four channels


class Drawing:
    """Lines of an SVG file."""

    def __init__(self) -> None:
        self._lines = [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 {TOP} {WIDTH} {HEIGHT - TOP}" '
            'font-family="sans-serif" font-size="13">',
            f'<rect y="{TOP}" width="{WIDTH}" height="{HEIGHT - TOP}" fill="white"/>',
        ]

    def rectangle(
        self, x: float, y: float, width: float, height: float, fill: str = BOX, dash: str = ""
    ) -> None:
        self._lines.append(
            f'<rect x="{x}" y="{y}" width="{width}" height="{height}" fill="{fill}" stroke="{INK}" '
            f'stroke-width="1.5" stroke-dasharray="{dash}"/>'
        )

    def wire(self, *points: tuple[float, float], colour: str = INK) -> None:
        text = " ".join(f"{x},{y}" for x, y in points)
        self._lines.append(f'<polyline points="{text}" fill="none" stroke="{colour}" stroke-width="1.5"/>')

    def dot(self, x: float, y: float) -> None:
        self._lines.append(f'<circle cx="{x}" cy="{y}" r="3" fill="{INK}"/>')

    def text(
        self, x: float, y: float, lines: str | Sequence[str], anchor: str = "middle", colour: str = INK
    ) -> None:
        for number, line in enumerate([lines] if isinstance(lines, str) else lines):
            self._lines.append(
                f'<text x="{x}" y="{y + 16 * number}" text-anchor="{anchor}" fill="{colour}">{line}</text>'
            )

    def ground(self, x: float, y: float) -> None:
        self.wire((x, y), (x, y + 6))
        for number in range(3):
            half = 8 - 3 * number
            self.wire((x - half, y + 6 + 3 * number), (x + half, y + 6 + 3 * number))

    def resistor(self, x: float, y: float, width: float = 30) -> None:
        self.rectangle(x, y - 5, width, 10, "white")

    def finish(self) -> str:
        return "\n".join([*self._lines, "</svg>\n"])


def draw() -> str:
    """Return the diagram of one pad's node as SVG."""
    drawing = Drawing()
    _draw_pad(drawing)
    _draw_computer(drawing)
    for number, (name, y) in enumerate(zip(ELECTRODES, ROWS, strict=True)):
        _draw_channel(drawing, number, name, y)
    drawing.text(
        WIDTH / 2,
        545,
        "One pad. Electrode order x0, xa, y0, yb = channels 1 to 4. Keep the four wires from sheet to "
        "amplifier short, together and shielded.",
    )
    return drawing.finish()


def _draw_pad(drawing: Drawing) -> None:
    """Draw the sheet with its electrodes, and the conducting layer above it."""
    drawing.text(150, 140, ["conducting layer (dashed),", "above the sheet"], colour=ACCENT)
    drawing.rectangle(50, 200, 160, 130, SHEET)
    drawing.rectangle(66, 184, 160, 130, "none", "6 4")
    drawing.text(130, 262, ["resistive", "sheet"])
    for x, y, width, height in ((46, 206, 8, 118), (206, 206, 8, 118), (56, 326, 148, 8), (56, 196, 148, 8)):
        drawing.rectangle(x, y, width, height, INK)
    drawing.text(34, 268, "x0")
    drawing.text(238, 292, "xa")
    drawing.text(112, 350, "y0")
    drawing.text(103, 192, "yb", "start")
    drawing.wire((46, 240), (20, 240), (20, 110), (290, 110), (290, ROWS[0]), (320, ROWS[0]))
    drawing.wire((214, 250), (290, 250), (290, ROWS[1]), (320, ROWS[1]))
    drawing.wire((130, 334), (130, 370), (290, 370), (290, ROWS[2]), (320, ROWS[2]))
    drawing.wire((90, 196), (90, 172), (10, 172), (10, ROWS[3]), (320, ROWS[3]))


def _draw_channel(drawing: Drawing, number: int, name: str, y: float) -> None:
    """Draw protection, amplifier and ADC input of one electrode."""
    drawing.text(312, y - 8, name, "end")
    drawing.wire((320, y), (400, y))
    drawing.dot(365, y)
    drawing.wire((365, y), (365, y + 14))
    drawing.wire((359, y + 14), (371, y + 14), (365, y + 24), (359, y + 14))  # clamp
    drawing.ground(365, y + 24)
    drawing.wire((430, y - 12), (430, y + 28), (470, y + 8), (430, y - 12))
    drawing.wire((400, y), (430, y))
    drawing.text(438, y + 4, "\u2212")
    drawing.text(438, y + 20, "+")
    drawing.wire((430, y + 16), (412, y + 16))
    drawing.ground(412, y + 16)
    drawing.dot(400, y)
    drawing.dot(490, y + 8)
    drawing.wire((400, y), (400, y - 26), (430, y - 26))
    drawing.resistor(430, y - 26)
    drawing.wire((460, y - 26), (490, y - 26), (490, y + 8))
    drawing.wire((470, y + 8), (500, y + 8))
    drawing.rectangle(500, y - 4, 34, 24, "white")
    drawing.wire((506, y + 2), (518, y + 2), (528, y + 14))  # low-pass
    drawing.wire((534, y + 8), (570, y + 8))
    drawing.text(576, y + 12, f"voltage{number}", "start")
    if number == 0:
        drawing.text(335, y + 28, "clamp")
        drawing.text(498, y - 10, "low-pass", "start")
        drawing.text(446, y - 36, f"{FEEDBACK_OHM} Ω ∥ {FEEDBACK_NF} nF")


def _draw_computer(drawing: Drawing) -> None:
    """Draw ADC, computer, CAN and the switch of the excitation."""
    drawing.rectangle(570, 120, 120, 310)
    drawing.text(630, 112, "ADC with IIO driver")
    drawing.text(630, 420, "±2.5 V supply")
    drawing.rectangle(770, 120, 150, 310)
    drawing.text(845, 150, ["Linux computer", "handtouch node"])
    for y, label in ((200, "SPI1"), (240, "data ready")):
        drawing.wire((690, y), (770, y), colour=GROUND)
        drawing.text(730, y - 6, label, colour=GROUND)
    drawing.rectangle(790, 250, 110, 40, "white")
    drawing.text(845, 267, ["CAN controller", "on SPI0"])
    drawing.rectangle(790, 310, 110, 30, "white")
    drawing.text(845, 330, "transceiver")
    drawing.wire((845, 290), (845, 310))
    for x, label, side in ((825, "CAN_H", "end"), (865, "CAN_L", "start")):
        drawing.wire((x, 340), (x, 490), colour=GROUND)
        drawing.text(x, 508, label, side, colour=GROUND)
    drawing.wire((825, 460), (830, 460), colour=GROUND)
    drawing.resistor(830, 460)
    drawing.wire((860, 460), (865, 460), colour=GROUND)
    drawing.text(875, 458, ["120 Ω", "at both ends"], "start")
    drawing.wire((770, 380), (720, 380), (720, 490), (420, 490), colour=ACCENT)
    drawing.text(742, 372, "GPIO 17", colour=ACCENT)
    drawing.rectangle(320, 470, 100, 40, "white")
    drawing.text(370, 487, ["load switch", f"+{DRIVE_V:g} V"])
    drawing.wire((320, 490), (246, 490), (246, 220), (226, 220), colour=ACCENT)
    drawing.text(283, 482, "excitation", colour=ACCENT)


if __name__ == "__main__":
    print(draw(), end="")
