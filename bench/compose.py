#!/usr/bin/env python3
"""Lines of bench/results/compose: what drawing 100 objects takes beside drawing the same splats as a part of the static scene.

bench/compose.py MODEL CAPTURE: a folder that plat train --objects wrote, and cameras. Copies of the model's objects are laid beside each
other along the street, once as objects with paths, once baked into a PLY. Each is drawn five times from all cameras, in turn; the
figures are medians of CPU seconds (pictures included, which are the same). PLAT is the program, RESULTS the folder of the lines.
"""
import array, json, math, os, shutil, statistics, subprocess, sys, tempfile

COUNT, ROUNDS = 100, 5
plat = os.environ.get("PLAT", "target/release/plat")
results = os.environ.get("RESULTS", "bench/results/compose")
model, capture = sys.argv[1:]


def read(path):
    """The lines of the header but the number of splats, the columns' names, and the rows as floats."""
    data = open(path, "rb").read()
    end = data.index(b"end_header\n") + 11
    lines = data[:end].decode().splitlines()
    names = [line.split()[-1] for line in lines if line.startswith("property")]
    assert all(line.split()[1] == "float" for line in lines if line.startswith("property")), path
    return lines, names, array.array("f", data[end:])


def write(path, lines, width, rows):
    lines = [f"element vertex {len(rows) // width}" if line.startswith("element") else line for line in lines]
    with open(path, "wb") as file:
        file.write(("\n".join(lines) + "\n").encode())
        rows.tofile(file)


def baked(names, rows, place, yaw):
    """Turned about z and moved; the SH coefficients stay, which changes colours but no work."""
    out, width = array.array("f", rows), len(names)
    at = {name: i for i, name in enumerate(names)}
    cos, sin = math.cos(yaw), math.sin(yaw)
    half = (math.cos(yaw / 2), math.sin(yaw / 2))
    for row in range(0, len(out), width):
        x, y, z = (out[row + at[name]] for name in "xyz")
        out[row + at["x"]], out[row + at["y"]] = cos * x - sin * y + place[0], sin * x + cos * y + place[1]
        out[row + at["z"]] = z + place[2]
        w, i, j, k = (out[row + at[f"rot_{n}"]] for n in range(4))
        c, s = half
        out[row + at["rot_0"]], out[row + at["rot_1"]] = c * w - s * k, c * i - s * j
        out[row + at["rot_2"]], out[row + at["rot_3"]] = c * j + s * i, c * k + s * w
    return out


work = tempfile.mkdtemp()
try:
    objects = json.load(open(f"{model}/objects/paths.json"))["tracks"]
    # Those along the street are laid on the paths of the given ones.
    spots = [pose for track in objects for pose in track["poses"]]
    shutil.copytree(model, f"{work}/objects", ignore=shutil.ignore_patterns("store", "eval"))
    shutil.rmtree(f"{work}/objects/objects")
    os.mkdir(f"{work}/objects/objects")
    header, names, all_rows = read(f"{model}/merged.ply")
    static = len(all_rows) // len(names)
    tracks = []
    for n in range(COUNT):
        track = objects[n % len(objects)]
        _, place, turn = spots[n * len(spots) // COUNT]
        yaw = 2 * math.atan2(turn[2], turn[3])
        turn = [0, 0, math.sin(yaw / 2), math.cos(yaw / 2)]
        name = f"copy-{n}"
        shutil.copy(f"{model}/objects/{track['id']}.ply", f"{work}/objects/objects/{name}.ply")
        tracks.append(track | {"id": name, "poses": [[0.0, place, turn], [1.0, place, turn]]})
        object_header, object_names, rows = read(f"{model}/objects/{track['id']}.ply")
        assert object_names == names, "objects of another SH degree"
        all_rows.extend(baked(names, rows, place, yaw))
    json.dump({"tracks": tracks}, open(f"{work}/objects/objects/paths.json", "w"))
    write(f"{work}/baked.ply", header, len(names), all_rows)

    def render(what, *options):
        command = [plat, "--quiet", "render", f"{work}/{what}", "--cameras", capture, "--out", f"{work}/renders", "--json",
                   "--backend", "cpu", *options]
        return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1])

    runs = {"objects": [], "baked": [], "static": []}
    for _ in range(ROUNDS):
        runs["objects"].append(render("objects", "--time", "0.5"))
        runs["baked"].append(render("baked.ply"))
        runs["static"].append(render("objects", "--without", "all"))
    seconds = {of: statistics.median(run["cpu_seconds"] for run in each) for of, each in runs.items()}
    commit = subprocess.run([plat, "--quiet", "eval", "--json", model, capture], capture_output=True, text=True).stdout
    line = {"kind": "compose", "commit": json.loads(commit.splitlines()[-1])["commit"] if commit else None,
            "backend": runs["objects"][0]["backend"], "objects": COUNT, "views": runs["objects"][0]["views"],
            "static_splats": static, "splats": len(all_rows) // len(names),
            "cpu_seconds": {of: round(value, 3) for of, value in seconds.items()},
            "ratios": [round(a["cpu_seconds"] / b["cpu_seconds"], 4) for a, b in zip(runs["objects"], runs["baked"])]}
    os.makedirs(results, exist_ok=True)
    with open(f"{results}/plat.jsonl", "a") as file:
        file.write(json.dumps(line) + "\n")
    print(json.dumps(line))
finally:
    shutil.rmtree(work)
