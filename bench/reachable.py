#!/usr/bin/env python3
"""How well held-out street photos can be painted with the training photos, if every depth is known: a bound for trainers.

    bench/reachable.py CAPTURE... >> bench/results/ladder/reachable.jsonl

Each CAPTURE is a folder of `plat synth --truth`; every 8th photo by name is held out. Each pixel of a held-out photo is
looked up, at its true depth, in the 60 nearest training photos that show the same surface (their true depth agrees to
3 %) and takes their mean, weighted by distance to the power of -4. `psnr_seen` covers the pixels that some training photo
shows; `psnr` the whole photo, of which the others (the sky, and what no photo shows) get their mean true colour. Means over the photos,
dB. Needs NumPy and Pillow.
"""

import json
import os
import sys

import numpy as np
from PIL import Image

NEAREST = 60
SAME_SURFACE = 0.03


class Photo:
    """A photo of a capture with its camera and truth."""

    def __init__(self, capture, frame):
        name = os.path.splitext(os.path.basename(frame["file_path"]))[0]
        self.colour = np.asarray(Image.open(f"{capture}/images/{name}.png").convert("RGB"), np.float64) / 255
        self.depth = np.load(f"{capture}/depth/{name}.npy")
        mask = f"{capture}/masks/{name}.png"
        self.used = np.asarray(Image.open(mask)) > 127 if os.path.exists(mask) else np.ones(self.depth.shape, bool)
        self.focal = np.array([frame["fl_x"], frame["fl_y"]])
        self.middle = np.array([frame["cx"], frame["cy"]])
        self.world_from_camera = pose(frame)

    def places(self):
        """World position of each pixel."""
        height, width = self.depth.shape
        pixel = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1) + 0.5
        ray = np.concatenate([(pixel - self.middle) / self.focal, np.ones((height, width, 1))], -1)
        return ray * self.depth[..., None] @ self.world_from_camera[:3, :3].T + self.world_from_camera[:3, 3]

    def look_up(self, places):
        """Colour at each place, and whether this photo shows its surface."""
        camera_from_world = np.linalg.inv(self.world_from_camera)
        seen = places @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
        depth = seen[..., 2]
        ahead = np.maximum(depth, 1e-6)[..., None]
        pixel = np.where(depth[..., None] > 0.1, seen[..., :2] / ahead * self.focal + self.middle, -1)
        size = np.array(self.depth.shape[::-1])
        inside = ((pixel > 1) & (pixel < size - 1)).all(-1)
        x, y = np.clip(pixel, 0, size - 1).astype(int).transpose(2, 0, 1)
        same = np.abs(self.depth[y, x] - depth) < SAME_SURFACE * depth
        corner = np.clip(pixel - 0.5, 0, size - 1.001)
        left, top = corner.astype(int).transpose(2, 0, 1)
        right, down = (corner % 1).transpose(2, 0, 1)[..., None]
        rows = [
            self.colour[row, left] * (1 - right) + self.colour[row, left + 1] * right for row in (top, top + 1)
        ]
        return rows[0] * (1 - down) + rows[1] * down, inside & same & self.used[y, x]


def pose(frame):
    """Camera to world, in OpenCV axes."""
    return np.array(frame["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0])


def measure(capture):
    with open(f"{capture}/transforms.json") as file:
        frames = sorted(json.load(file)["frames"], key=lambda frame: frame["file_path"])
    train = [frame for index, frame in enumerate(frames) if index % 8]
    centres = np.array([pose(frame)[:3, 3] for frame in train])
    held_out = [f for f in frames[::8] if os.path.basename(f["file_path"]).startswith("street")]
    rows = []
    for number, frame in enumerate(held_out):
        print(f"{capture}: photo {number + 1} of {len(held_out)}", end="\r", file=sys.stderr)
        photo = Photo(capture, frame)
        places, surface = photo.places(), photo.depth > 0
        colour, weight = np.zeros(photo.colour.shape), np.zeros(surface.shape)
        for other in np.argsort(np.linalg.norm(centres - photo.world_from_camera[:3, 3], axis=1))[:NEAREST]:
            other = Photo(capture, train[other])
            found, shown = other.look_up(places)
            closeness = shown * surface * np.linalg.norm(places - other.world_from_camera[:3, 3], axis=-1) ** -4.0
            colour += found * closeness[..., None]
            weight += closeness
        seen, unseen = (weight > 0) & photo.used, (weight == 0) & photo.used
        if not seen.any():
            continue
        error = (colour / np.maximum(weight, 1e-300)[..., None] - photo.colour) ** 2
        if unseen.any():
            error[unseen] = (photo.colour[unseen].mean(0) - photo.colour[unseen]) ** 2
        decibels = [-10 * np.log10(error[pixels].mean()) for pixels in (seen, photo.used)]
        rows.append([*decibels, (seen & surface).sum() / max(1, (surface & photo.used).sum())])
    return len(rows), *np.mean(rows, 0)


if len(sys.argv) == 1:
    sys.exit("bench/reachable.py: give folders of plat synth --truth")
for path in sys.argv[1:]:
    if not os.path.isdir(f"{path}/depth"):
        sys.exit(f"bench/reachable.py: {path}/depth does not exist: give a folder of plat synth --truth")
    photos, psnr_seen, psnr, share = measure(path)
    line = {"scene": os.path.basename(os.path.normpath(path)), "photos": photos, "psnr_seen": psnr_seen, "psnr": psnr}
    print(json.dumps({**line, "surface_seen": share}), flush=True)
