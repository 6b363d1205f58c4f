"""Compares pictures of a viewer with plat's: compare.py VIEWER CAMERAS THEIRS OURS OUT AERIAL STREET, the last two the least PSNR in dB."""

import json
import math
import sys

import numpy
from PIL import Image

viewer, cameras, theirs, ours, out, *least = sys.argv[1:]
worst = {}
for index, frame in enumerate(json.load(open(cameras))["frames"]):
    name = frame["file_path"].removeprefix("images/")
    pictures = [Image.open(path).convert("RGB") for path in (f"{theirs}/{viewer}-{index}.png", f"{ours}/images/{name}")]
    difference = numpy.subtract(*(numpy.asarray(picture, float) for picture in pictures))
    psnr = 10 * math.log10(255**2 / max((difference**2).mean(), 1e-9))
    both = Image.new("RGB", (2 * pictures[0].width, pictures[0].height))
    for side, picture in enumerate(pictures):
        both.paste(picture, (side * picture.width, 0))
    both.save(f"{out}/{viewer}-{name}")
    print(f"{name}: {psnr:.2f} dB between {viewer} and plat")
    kind = name.split("-")[0]
    worst[kind] = min(worst.get(kind, math.inf), psnr)
assert worst["aerial"] > float(least[0]) and worst["street"] > float(least[1]), worst
