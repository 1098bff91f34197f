"""Horn's method in the plane: five pairs, exact, with noise, and with scale.

Which rotation and translation bring a set of points onto their known partners? The answer is a formula: centre both
sets, sum the products W = sum b'_i a'_i^T, take its singular value decomposition U S V^T, and R = U V^T.

    python examples/01_horn_2d.py [--out FOLDER]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from scanweld.registration.closed_form import align_closed_form
from scanweld.registration.explain import WORKED_SOURCE, WORKED_TARGET, explain_horn
from scanweld.registration.pictures import draw_horn

parser = argparse.ArgumentParser(description="Horn's method in the plane.")
parser.add_argument("--out", type=Path, default=Path(__file__).parent / "output", help="where the picture goes")
out = parser.parse_args().out
out.mkdir(parents=True, exist_ok=True)

# The source: five points. The target: the same points turned by 45 degrees and moved by (2, 3).
source = WORKED_SOURCE
c = np.sqrt(0.5)
rotation = np.array([[c, -c], [c, c]])
exact = source @ rotation.T + [2, 3]

result = align_closed_form(source, exact)
print("1. Exact pairs")
print(f"   {result.status.name}, rmse {result.rmse_m:.1e} m, T_target_source =")
print(np.array2string(result.T_target_source, precision=5, suppress_small=True, prefix="   "))

# With a few centimetres of noise the answer is the least-squares one. Every step of it, for reading along:
print("\n2. The same with noise, every step\n")
noisy = explain_horn(source, WORKED_TARGET)
print(noisy.text())

# A scale is estimated only when asked for, and it has two definitions that agree on exact pairs only.
print("3. Pairs that are 2.7 times larger")
for name in ("symmetric", "least_squares"):
    scaled = align_closed_form(source, 2.7 * source @ rotation.T + [2, 3], scale=name)
    with_noise = align_closed_form(source, WORKED_TARGET, scale=name)
    print(f"   {name:>13}: {scaled.scale:.4f} exact; on the noisy pairs of 2 {with_noise.scale:.4f}")

# Three points on a line do not say how far the set turned about it; the result says that instead of guessing.
line = np.array([[0, 0, 0], [1, 0, 0], [3, 0, 0]])
result = align_closed_form(line, line + [0, 1, 0])
print(f"\n4. Points on a line in space\n   {result.status.name}: {result.note}")

draw_horn(out / "01_horn_2d.png", noisy)
print(f"\nwrote {out / '01_horn_2d.png'}")
