"""Tables that the kernel looks numbers up in: python -m tests.kernels.number_tables writes them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from decimal import Decimal, localcontext
from importlib.resources import files
from pathlib import Path

KERNELS = Path(str(files("dwell.kernels")))

#: Steps from one whole power of two to the next.
POWERS = 128
#: Layers of the ziggurat; where its tail begins; the area of each layer, where the first has the
#: tail and the rectangle beside it.
LAYERS = 256
TAIL = 3.6541528853610088
AREA = 0.0049286732339746519
#: A draw has 52 bits beside those of its layer and its sign.
STEPS = 2.0**52
#: Whose density NumPy has one unit in the last place higher than it is.
ROUNDED_UP = 38


def main() -> None:
    """Write the headers."""
    for name, text in headers().items():
        (KERNELS / name).write_text(text, encoding="utf-8")


def headers() -> dict[str, str]:
    """Return the text of each header by its name."""
    return {"powers_of_two.h": powers_of_two(), "ziggurat_tables.h": ziggurat_tables()}


def powers_of_two() -> str:
    """Compute 2^(i / 128), and what its rounding has lost."""
    with localcontext(prec=50):
        exact = [Decimal(2) ** (Decimal(i) / POWERS) for i in range(POWERS)]
        powers = [float(power) for power in exact]
        lost = [
            float(power / Decimal(found) - 1) for power, found in zip(exact, powers, strict=True)
        ]
    return _header(
        f"Powers of two with exponents between 0 and 1, in {POWERS} steps.",
        _table(f"2^(i / {POWERS}).", "double", "kPower", map(float.hex, powers)),
        _table(
            "What is lost by rounding it, as a share of it.",
            "double",
            "kPowerLost",
            map(float.hex, lost),
        ),
    )


def ziggurat_tables() -> str:
    """Compute what NumPy's `standard_normal` knows of each layer of the normal density.

    The layers are those of Marsaglia and Tsang (2000, DOI 10.18637/jss.v005.i08). NumPy's were made
    in doubles from the outermost one inwards: their last bits have the rounding of all further out.
    """
    ends, density = [0.0] * LAYERS, [1.0] * LAYERS
    ends[-1], density[-1] = TAIL, _exp(-0.5 * TAIL * TAIL)
    for i in range(LAYERS - 2, 0, -1):
        ends[i] = math.sqrt(-2 * _log(density[i + 1] + AREA / ends[i + 1]))
        density[i] = _exp(-0.5 * ends[i] * ends[i])
        if i == ROUNDED_UP:
            density[i] = math.nextafter(density[i], 1)
    inside = [TAIL * density[-1] / AREA, *(ends[i - 1] / ends[i] for i in range(1, LAYERS))]
    steps = [AREA / density[-1] / STEPS, *(end / STEPS for end in ends[1:])]
    return _header(
        "Layers of the normal density: the tail and what is below it, then from the top downwards.",
        _table(
            "Steps from the middle below which all of the layer is under the density.",
            "uint64_t",
            "kInside",
            (hex(round(share * STEPS)) for share in inside),
        ),
        _table("Width of one step.", "double", "kStep", map(float.hex, steps)),
        _table("exp(-x^2 / 2) at the layer's end.", "double", "kDensity", map(float.hex, density)),
    )


def _exp(x: float) -> float:
    """Return exp(x), correctly rounded."""
    with localcontext(prec=50):
        return float(Decimal(x).exp())


def _log(x: float) -> float:
    """Return log(x), correctly rounded."""
    with localcontext(prec=50):
        return float(Decimal(x).ln())


def _header(what: str, *tables: str) -> str:
    return "\n".join(
        [
            "#pragma once",
            "",
            f"// {what}",
            "// Written by python -m tests.kernels.number_tables.",
            "",
            "#include <cstdint>",
            "",
            "namespace dwell {",
            "",
            "// clang-format off",
            *tables,
            "// clang-format on",
            "",
            "}  // namespace dwell",
            "",
        ]
    )


def _table(what: str, kind: str, name: str, numbers: Iterable[str]) -> str:
    texts = list(numbers)
    rows = [", ".join(texts[i : i + 4]) for i in range(0, len(texts), 4)]
    body = "".join(f"\n    {row}," for row in rows)
    return f"// {what}\ninline constexpr {kind} {name}[{len(texts)}] = {{{body}\n}};"


if __name__ == "__main__":
    main()
