"""Makes what the tests of `perceive` compare with: the networks `*_tiny.onnx` beside this file, the numbers of
onnxruntime in `../src/detector/expected.rs`, and those of pycocotools in `../src/precision/expected.rs`.

    pip install numpy onnx onnxruntime pillow pycocotools
    python expected.py ../../../shared/data       # the folder with detectors/ and images_street/

Pictures are resized in double precision, as `placed` describes it. The heads are decoded here with numpy after what
their authors publish: YOLOX's demo_postprocess, Ultralytics' predictor, FastestDet's example for onnxruntime, and
NanoDet-Plus' get_bboxes.
"""

import contextlib
import io
import pathlib
import sys

import numpy as np
import onnx
import onnxruntime as ort
from onnx import TensorProto, helper, numpy_helper
from PIL import Image
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

HERE = pathlib.Path(__file__).parent
CLASSES, BINS = 3, 8  # of the tiny networks


# ---------------------------------------------------------------------------------------------------- tiny networks

def tiny(head, width, height, strides):
    """A network with random weights and a head's layout: mean of each cell, two layers, the head."""
    random = np.random.RandomState(len(head))
    nodes, constants, outputs = [], [], []
    numbers = 4 + CLASSES if head == "yolov8" else CLASSES + 4 * BINS

    def constant(name, value):
        constants.append(numpy_helper.from_array(np.asarray(value), name))
        return name

    def node(kind, inputs, output, **attributes):
        if kind == "Conv":  # rten wants what ONNX leaves open, and every exporter writes
            attributes = {"kernel_shape": [1, 1], "strides": [1, 1], "pads": [0] * 4, "dilations": [1, 1]}
        nodes.append(helper.make_node(kind, inputs, [output], **attributes))
        return output

    hidden = constant("w1", random.normal(0, 3 if head == "yolov8" else 0.7, (12, 3, 1, 1)).astype(np.float32))
    shift = constant("b1", random.normal(0, 2, 12).astype(np.float32))
    out = constant("w2", random.normal(0, 0.5, (numbers, 12, 1, 1)).astype(np.float32))
    shape = constant("shape", np.array([1, numbers, -1], np.int64))
    for s in strides:
        mean = node("AveragePool", ["images"], f"mean{s}", kernel_shape=[s, s], strides=[s, s])
        inner = node("Tanh", [node("Conv", [mean, hidden, shift], f"conv{s}")], f"inner{s}")
        outputs.append(node("Reshape", [node("Conv", [inner, out], f"out{s}"), shape], f"flat{s}"))
    every = node("Concat", outputs, "every", axis=2)

    def part(name, first, last):
        ends = [constant(f"{name}{i}", np.array([v], np.int64)) for i, v in enumerate((first, last, 1))]
        return node("Slice", [every, *ends], name)

    if head == "yolov8":
        cells = np.concatenate([grid(s, width, height) for s in strides])
        steps = np.concatenate([np.full(len(grid(s, width, height)), s) for s in strides])
        centre = (cells * steps[:, None]).T
        base = np.concatenate([centre, np.zeros_like(centre)])[None].astype(np.float32)
        scale = np.stack([steps, steps, 4 * steps, 3 * steps])[None].astype(np.float32)
        share = node("Sigmoid", [part("box", 0, 4)], "share")
        sized = node("Mul", [share, constant("scale", scale)], "sized")
        placed = node("Add", [sized, constant("base", base)], "placed")
        node("Concat", [placed, node("Sigmoid", [part("class", 4, numbers)], "score")], "output", axis=1)
        shape = [1, numbers, len(cells)]
    else:
        score = node("Sigmoid", [part("class", 0, CLASSES)], "score")
        node("Transpose", [node("Concat", [score, part("box", CLASSES, numbers)], "both", axis=1)], "output",
             perm=[0, 2, 1])
        shape = [1, sum(len(grid(s, width, height)) for s in strides), numbers]
    graph = helper.make_graph(
        nodes, head, [helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, height, width])],
        [helper.make_tensor_value_info("output", TensorProto.FLOAT, shape)], constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 11)], ir_version=6)
    onnx.checker.check_model(model)
    onnx.save(model, HERE / f"{head}_tiny.onnx")


# --------------------------------------------------------------------------------------------- pictures and decoding

def resized(picture, width, height):
    """Bilinear between pixel centres, in double precision."""
    def taps(to, size):
        centre = np.clip((np.arange(to) + 0.5) * size / to - 0.5, 0, size - 1)
        first = centre.astype(int)
        return first, np.minimum(first + 1, size - 1), centre - first
    (top, bottom, down), (left, right, along) = taps(height, picture.shape[0]), taps(width, picture.shape[1])
    row = picture[:, left] + along[:, None] * (picture[:, right] - picture[:, left])
    return row[top] + down[:, None, None] * (row[bottom] - row[top])


def placed(picture, width, height, way, mean, std, bgr):
    """The input, and a function from its corners to the picture's."""
    h, w = picture.shape[:2]
    scale = min(width / w, height / h)
    inner = (width, height) if way == "stretch" else (int(w * scale + 1e-9), int(h * scale + 1e-9))
    x, y = ((width - inner[0]) // 2, (height - inner[1]) // 2) if way == "centre" else (0, 0)
    image = np.full((height, width, 3), 114.0)
    image[y:y + inner[1], x:x + inner[0]] = resized(picture, *inner)
    image = (image[:, :, ::-1] if bgr else image)
    data = np.ascontiguousarray(((image - mean) / std).transpose(2, 0, 1)[None], np.float32)

    def back(boxes):
        scale = np.array([w / inner[0], h / inner[1]] * 2)
        return np.clip((boxes - [x, y, x, y]) * scale, 0, [w, h, w, h])
    return data, back


def grid(stride, width, height):
    columns, rows = -(-width // stride), -(-height // stride)
    return np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).reshape(-1, 2)


def centred(centre, size):
    return np.concatenate([centre - size / 2, centre + size / 2], -1)


def yolox(out, width, height):
    strides = np.concatenate([np.full((len(grid(s, width, height)), 1), s) for s in (8, 16, 32)])
    cells = np.concatenate([grid(s, width, height) for s in (8, 16, 32)])
    out = out[0].astype(float)
    boxes = centred((out[:, :2] + cells) * strides, np.exp(out[:, 2:4]) * strides)
    return boxes, out[:, 4] * out[:, 5:].max(1), out[:, 5:].argmax(1)


def yolov8(out, width, height):
    out = out[0].T.astype(float)
    return centred(out[:, :2], out[:, 2:4]), out[:, 4:].max(1), out[:, 4:].argmax(1)


def fastestdet(out, width, height):
    out = out[0].astype(float)
    numbers, rows, columns = out.shape
    out = out.reshape(numbers, -1).T
    centre = (np.tanh(out[:, 1:3]) + grid(16, width, height)) / [columns, rows] * [width, height]
    size = 1 / (1 + np.exp(-out[:, 3:5])) * [width, height]
    return centred(centre, size), out[:, 0] ** 0.6 * out[:, 5:].max(1) ** 0.4, out[:, 5:].argmax(1)


def nanodet(out, width, height):
    out = out[0].astype(float)
    strides = np.concatenate([np.full((len(grid(s, width, height)), 1), s) for s in (8, 16, 32, 64)])
    centre = np.concatenate([grid(s, width, height) for s in (8, 16, 32, 64)]) * strides
    bins = out[:, CLASSES:].reshape(len(out), 4, BINS)
    share = np.exp(bins - bins.max(-1, keepdims=True))
    side = (share / share.sum(-1, keepdims=True)) @ np.arange(BINS) * strides
    boxes = np.concatenate([centre - side[:, :2], centre + side[:, 2:]], -1)
    return boxes, out[:, :CLASSES].max(1), out[:, :CLASSES].argmax(1)


def iou(a, b):
    side = np.maximum(0, np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]))
    common = side.prod()
    return common / ((a[2:] - a[:2]).prod() + (b[2:] - b[:2]).prod() - common)


def kept(boxes, scores, classes, least):
    """Non-maximum suppression by class at 0.45, best first."""
    found = []
    for i in np.argsort(-scores, kind="stable"):
        if scores[i] >= least and (boxes[i, 2:] > boxes[i, :2]).all():
            if all(classes[j] != classes[i] or iou(boxes[i], boxes[j]) <= 0.45 for j in found):
                found.append(i)
    return [(int(classes[i]), scores[i], boxes[i]) for i in found]


# ------------------------------------------------------------------------------------------------------------ output

# Head, file, width, height, way, mean, std, BGR, least score; None: that of the best half, at most twelve.
NANODET = ([103.53, 116.28, 123.675], [57.375, 57.12, 58.395])
HEADS = [
    (yolox, "detectors/yolox_nano_416.onnx", 416, 416, "corner", 0.0, 1.0, True, 0.12),
    (fastestdet, "detectors/fastestdet_352.onnx", 352, 352, "stretch", 0.0, 255.0, True, 0.55),
    (yolov8, "yolov8_tiny.onnx", 96, 64, "centre", 0.0, 255.0, False, None),
    (nanodet, "nanodet_tiny.onnx", 128, 64, "stretch", *NANODET, True, None),
]
# File and columns.
PHOTOS = [("000000.png", 0, 1224), ("000001.png", 350, 850), ("000002.png", 430, 830)]


def drawn():
    """The picture of a formula that the tiny networks are run on."""
    y, x, c = np.meshgrid(np.arange(70), np.arange(120), np.arange(3), indexing="ij")
    return ((x * x * (c + 1) // 30 + y * (3 * c + 2)) % 256).astype(float)


def detections(data):
    lines = ["//! Made by `tests/expected.py`: what onnxruntime and numpy give for pictures, for the tests of the detector.",
             "", "use super::tests::Expected;", "", "#[rustfmt::skip]", "pub(super) const EXPECTED: &[Expected] = &["]
    for head, file, width, height, way, mean, std, bgr, least in HEADS:
        path = HERE / file if "tiny" in file else data / file
        session = ort.InferenceSession(str(path), providers=["CPUExecutionProvider"])
        pictures = PHOTOS if "tiny" not in file else [(None, 0, 120)]
        for photo, first, last in pictures:
            picture = drawn() if photo is None else np.asarray(
                Image.open(data / "images_street/kitti_object/image_2" / photo).convert("RGB")).astype(float)
            picture = picture[:, first:last]
            values, back = placed(picture, width, height, way, mean, std, bgr)
            out = session.run(None, {session.get_inputs()[0].name: values})[0]
            boxes, scores, classes = head(out, width, height)
            if least is None:
                best = [score for _, score, _ in kept(back(boxes), scores, classes, 0.0)]
                middle = min(12, len(best) // 2)
                least = round(float(best[middle - 1] + best[middle]) / 2, 6)
            found = kept(back(boxes), scores, classes, least)
            flat = out.ravel()
            at = (np.arange(24) * 7919 + 311) % flat.size
            lines += ["    Expected {", f'        network: "{file}",',
                      f"        photo: {'None' if photo is None else f'Some({chr(34)}{photo}{chr(34)})'},",
                      f"        columns: {first}..{last},",
                      f"        sum: {np.abs(flat.astype(float)).sum():.4f},", f"        least: {least},",
                      "        raw: &["]
            lines += ["            " + " ".join(f"({i}, {number(flat[i])})," for i in row) for row in at.reshape(-1, 4)]
            lines += ["        ],", "        boxes: &["]
            lines += [f"            ({c}, {s:.6f}, [{', '.join(f'{v:.3f}' for v in b)}])," for c, s, b in found]
            lines += ["        ],", "    },"]
            print(file, photo, len(found), "boxes")
    lines += ["];", ""]
    (HERE / "../src/detector/expected.rs").write_text("\n".join(lines))


def number(value):
    text = f"{float(value):.7g}"
    return text if "." in text or "e" in text else text + ".0"


class Numbers:
    """A linear congruential generator that the Rust test has too; 0..1."""

    def __init__(self, seed):
        self.state = seed

    def next(self):
        self.state = (self.state * 6364136223846793005 + 1442695040888963407) % 2**64
        return np.float32((self.state >> 40) / 2**24)


def boxes(seed, views, classes):
    """For each view true boxes (class, corners, counts), and found ones (class, score, corners)."""
    n, result = Numbers(seed), []
    for _ in range(views):
        true, found = [], []
        for _ in range(int(n.next() * np.float32(12))):
            left, top = n.next() * np.float32(200), n.next() * np.float32(100)
            width, height = n.next() * np.float32(60) + np.float32(5), n.next() * np.float32(60) + np.float32(5)
            box = [left, top, left + width, top + height]
            c, counts = int(n.next() * np.float32(classes)), n.next() > np.float32(0.2)
            true.append((c, box, bool(counts)))
            for _ in range(int(n.next() * np.float32(3))):
                jitter = [(n.next() - np.float32(0.5)) * np.float32(12) for _ in range(4)]
                same = n.next() > np.float32(0.15)
                # Scores in steps: some are equal.
                score = np.floor(n.next() * np.float32(16)) / np.float32(16)
                found.append((c if same else 0, score, [a + b for a, b in zip(box, jitter)]))
        result.append((true, found))
    return result


def precision():
    lines = ["//! Made by `tests/expected.py`: what pycocotools gives for boxes of a generator.", "",
             "/// Seed, views, classes, mAP@[.5:.95], mAP@.5.", "#[rustfmt::skip]",
             "pub(super) const EXPECTED: &[(u64, usize, usize, f64, f64)] = &["]
    for seed, views, classes in [(1, 1, 1), (2, 4, 2), (3, 12, 3), (4, 40, 5), (5, 80, 1)]:
        made = boxes(seed, views, classes)
        xywh = lambda b: [float(b[0]), float(b[1]), float(b[2]) - float(b[0]), float(b[3]) - float(b[1])]
        truth = COCO()
        truth.dataset = {"info": {}, "images": [{"id": v + 1} for v in range(views)],
                         "categories": [{"id": c + 1} for c in range(classes)], "annotations": []}
        results = []
        for v, (true, found) in enumerate(made):
            for c, box, counts in true:
                # Boxes that do not count have an area that is left out.
                truth.dataset["annotations"].append({
                    "id": len(truth.dataset["annotations"]) + 1, "image_id": v + 1, "category_id": c + 1,
                    "bbox": xywh(box), "area": 100.0 if counts else 1.0, "iscrowd": 0})
            results += [{"image_id": v + 1, "category_id": c + 1, "bbox": xywh(box), "score": float(s)}
                        for c, s, box in found]
        with contextlib.redirect_stdout(io.StringIO()):
            truth.createIndex()
            found = truth.loadRes(results)
            # A found box of less than 8 pixels' height does not count as an error.
            for one in found.anns.values():
                one["area"] = 100.0 if one["bbox"][3] >= 8.0 else 1.0
            judge = COCOeval(truth, found, "bbox")
            judge.params.areaRng, judge.params.areaRngLbl = [[50.0, 1e9]], ["all"]
            judge.params.maxDets = [100]
            judge.evaluate()
            judge.accumulate()
        values = judge.eval["precision"]
        mean = lambda v: v[v > -1].mean()
        lines.append(f"    ({seed}, {views}, {classes}, {mean(values):.12f}, {mean(values[0]):.12f}),")
        print(lines[-1])
    lines += ["];", ""]
    (HERE / "../src/precision/expected.rs").write_text("\n".join(lines))


if __name__ == "__main__":
    tiny("yolov8", 96, 64, (8, 16, 32))
    tiny("nanodet", 128, 64, (8, 16, 32, 64))
    (HERE / "../src/precision").mkdir(exist_ok=True)
    detections(pathlib.Path(sys.argv[1]))
    precision()
