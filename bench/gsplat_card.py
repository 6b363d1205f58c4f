"""gsplat on this machine's CUDA card, for comparison with `bench/card.sh`: the same photos, held-out views and numbers of splats.

`train CAPTURE` trains with gsplat's own defaults (examples/simple_trainer.py: losses, learning rates, schedules, all schedules scaled to
--steps as its steps_scaler does), fused Adam and fused SSIM, all photos on the card. `render CAPTURE --ply FILE` times forward and backward
passes of one model. Both read the capture's COLMAP model and print one JSON line. Clocks exclude reading photos and evaluation.
Needs gsplat, torch, numpy, scipy, pillow, and fused_ssim for `train`.
"""

import argparse, json, math, struct, time
from pathlib import Path

import numpy as np
import torch
from gsplat import DefaultStrategy, MCMCStrategy, rasterization
from PIL import Image
from scipy.spatial import cKDTree

SH_C0 = 0.28209479177387814


def colmap(capture):
    """Names, world-to-camera matrices [V, 4, 4], intrinsics [V, 3, 3], points [N, 3] and colours [N, 3] of a binary model of pinholes."""
    at = capture / "sparse/0"
    cameras, names, poses, ks = {}, [], [], []
    with open(at / "cameras.bin", "rb") as f:
        for _ in range(struct.unpack("<Q", f.read(8))[0]):
            number, model, _, _ = struct.unpack("<iiQQ", f.read(24))
            p = struct.unpack(f"<{3 + model}d", f.read(8 * (3 + model)))  # 0: simple pinhole, 1: pinhole
            fx, fy, cx, cy = p if model else (p[0], p[0], p[1], p[2])
            cameras[number] = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
    with open(at / "images.bin", "rb") as f:
        for _ in range(struct.unpack("<Q", f.read(8))[0]):
            _, w, x, y, z, *t, camera = struct.unpack("<i7di", f.read(64))
            name = b"".join(iter(lambda: f.read(1), b"\0")).decode()
            f.seek(24 * struct.unpack("<Q", f.read(8))[0], 1)
            pose = np.eye(4)
            pose[:3, :3] = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]
            pose[:3, 3] = t
            names.append(name), poses.append(pose), ks.append(cameras[camera])
    points, colours = [], []
    with open(at / "points3D.bin", "rb") as f:
        for _ in range(struct.unpack("<Q", f.read(8))[0]):
            _, x, y, z, r, g, b, _, track = struct.unpack("<Q3d3BdQ", f.read(51))
            f.seek(8 * track, 1)
            points.append((x, y, z)), colours.append((r, g, b))
    order = np.argsort(names)
    return [names[i] for i in order], np.array(poses)[order], np.array(ks)[order], np.array(points), np.array(colours) / 255


def cuda(array):
    return torch.tensor(np.asarray(array), dtype=torch.float32, device="cuda")


def draw(splats, view, k, size, degree):
    colours = torch.cat([splats["sh0"], splats["shN"]], 1)
    return rasterization(splats["means"], splats["quats"], splats["scales"].exp(), splats["opacities"].sigmoid(), colours, view[None], k[None],
                         size[0], size[1], sh_degree=degree, packed=False)


def train(args):
    from fused_ssim import fused_ssim

    names, poses, ks, points, colours = colmap(args.capture)
    # The trainer's normalisation: cameras within about one unit of the origin.
    centres = np.array([-pose[:3, :3].T @ pose[:3, 3] for pose in poses])
    middle = centres.mean(0)
    scale = 1 / np.linalg.norm(centres - middle, axis=1).max()
    poses[:, :3, 3] = scale * (poses[:, :3, 3] + poses[:, :3, :3] @ middle)
    points, scene_scale = scale * (points - middle), 1.1
    photos = [torch.tensor(np.array(Image.open(args.capture / "images" / name).convert("RGB")), device="cuda") for name in names]
    poses, ks = cuda(poses), cuda(ks)
    size = (photos[0].shape[1], photos[0].shape[0])
    train_views = [i for i in range(len(names)) if i % args.test_every]
    test_views = [i for i in range(len(names)) if i % args.test_every == 0]

    torch.manual_seed(args.seed)
    mcmc = args.strategy == "mcmc"
    near = np.sqrt((cKDTree(points).query(points, 4)[0][:, 1:] ** 2).mean(1)).clip(1e-7)
    count, opacity = len(points), 0.5 if mcmc else 0.1
    tensors = {
        "means": (cuda(points), 1.6e-4 * scene_scale),
        "scales": (cuda(np.log(near * (0.1 if mcmc else 1)))[:, None].repeat(1, 3), 5e-3),
        "quats": (torch.rand(count, 4, device="cuda"), 1e-3),
        "opacities": (torch.full((count,), math.log(opacity / (1 - opacity)), device="cuda"), 5e-2),
        "sh0": (cuda((colours - 0.5) / SH_C0)[:, None], 2.5e-3),
        "shN": (torch.zeros(count, 15, 3, device="cuda"), 2.5e-3 / 20),
    }
    splats = torch.nn.ParameterDict({name: torch.nn.Parameter(value) for name, (value, _) in tensors.items()}).cuda()
    optimisers = {name: torch.optim.Adam([{"params": splats[name], "lr": rate, "name": name}], eps=1e-15, fused=True)
                  for name, (_, rate) in tensors.items()}
    decay = torch.optim.lr_scheduler.ExponentialLR(optimisers["means"], gamma=0.01 ** (1 / args.steps))
    scaled = lambda steps: max(1, round(steps * args.steps / 30_000))
    if mcmc:
        strategy = MCMCStrategy(cap_max=args.cap, refine_start_iter=scaled(500), refine_stop_iter=scaled(25_000), refine_every=scaled(100))
        state = strategy.initialize_state()
    else:
        strategy = DefaultStrategy(refine_start_iter=scaled(500), refine_stop_iter=scaled(15_000), reset_every=scaled(3_000),
                                   refine_every=scaled(100), pause_refine_after_reset=0)
        state = strategy.initialize_state(scene_scale=scene_scale)
    strategy.check_sanity(splats, optimisers)

    def measure():
        by_kind, ssims = {}, []
        with torch.no_grad():
            for i in test_views:
                image = draw(splats, poses[i], ks[i], size, 3)[0][0].clamp(0, 1)
                truth = photos[i].float() / 255
                by_kind.setdefault(names[i].split("-")[0], []).append(-10 * math.log10(((image - truth) ** 2).mean().item()))
                ssims.append(fused_ssim(image.permute(2, 0, 1)[None], truth.permute(2, 0, 1)[None], train=False).item())
        every = sum(by_kind.values(), [])
        return {"psnr": np.mean(every), "ssim": np.mean(ssims)} | ({k: np.mean(v) for k, v in by_kind.items()} if len(by_kind) < 9 else {})

    torch.cuda.synchronize()
    began, waiting = time.perf_counter(), []
    for step in range(args.steps):
        if not waiting:
            waiting = list(np.random.RandomState(args.seed * 100_003 + step).permutation(train_views))
        i = waiting.pop()
        image, _, info = draw(splats, poses[i], ks[i], size, min(step // scaled(1000), 3))
        if not mcmc:
            strategy.step_pre_backward(splats, optimisers, state, step, info)
        truth = photos[i].float()[None] / 255
        loss = 0.8 * (image - truth).abs().mean() + 0.2 * (1 - fused_ssim(image.permute(0, 3, 1, 2), truth.permute(0, 3, 1, 2), padding="valid"))
        if mcmc:
            loss = loss + 0.01 * splats["opacities"].sigmoid().mean() + 0.01 * splats["scales"].exp().mean()
        loss.backward()
        for optimiser in optimisers.values():
            optimiser.step()
            optimiser.zero_grad(set_to_none=True)
        decay.step()
        if mcmc:
            strategy.step_post_backward(splats, optimisers, state, step, info, lr=decay.get_last_lr()[0])
        else:
            strategy.step_post_backward(splats, optimisers, state, step, info, packed=False)
    torch.cuda.synchronize()
    seconds = time.perf_counter() - began
    return {"steps": args.steps, "strategy": args.strategy, "seed": args.seed, "seconds": seconds, "steps_per_second": args.steps / seconds,
            "splats": len(splats["means"]), **measure()}


def render(args):
    names, poses, ks, *_ = colmap(args.capture)
    # The binary layout of the original implementation: all properties are floats.
    data = args.ply.read_bytes()
    header, data = data.split(b"end_header\n", 1)
    lines = header.decode().split("\n")
    fields = [line.split()[2] for line in lines if line.startswith("property float")]
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    table = np.frombuffer(data, np.float32, count * len(fields)).reshape(count, -1)
    column = lambda *prefixes: table[:, [i for i, field in enumerate(fields) if field.startswith(prefixes)]]
    rest = column("f_rest_")
    rest = rest.reshape(count, 3, -1).transpose(0, 2, 1) if rest.size else np.zeros((count, 0, 3))
    splats = {"means": column("x", "y", "z"), "scales": column("scale_"), "quats": column("rot_"), "opacities": column("opacity")[:, 0],
              "sh0": column("f_dc_")[:, None], "shN": rest}
    splats = {name: cuda(value).requires_grad_() for name, value in splats.items()}
    width, height = map(int, args.size.split("x"))
    wide, tall = Image.open(args.capture / "images" / names[0]).size
    ks[:, 0] *= width / wide
    ks[:, 1] *= height / tall
    poses, ks = cuda(poses), cuda(ks)
    times = [[], []]
    for n in range(args.passes + 20):
        i = n % len(names)
        events = [torch.cuda.Event(enable_timing=True) for _ in range(3)]
        events[0].record()
        image, *_ = draw(splats, poses[i], ks[i], (width, height), math.isqrt(splats["shN"].shape[1] + 1) - 1)
        events[1].record()
        image.backward(torch.full_like(image, 1e-3))
        events[2].record()
        torch.cuda.synchronize()
        if n >= 20:
            times[0].append(events[0].elapsed_time(events[1]))
            times[1].append(events[1].elapsed_time(events[2]))
        for value in splats.values():
            value.grad = None
    return {"splats": count, "size": args.size, "forward_millis": np.median(times[0]), "backward_millis": np.median(times[1])}


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("what", choices=["train", "render"])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--scene")
    parser.add_argument("--steps", type=int, default=30_000)
    parser.add_argument("--strategy", choices=["mcmc", "default"], default="mcmc")
    parser.add_argument("--cap", type=int, default=1_000_000, help="most splats, with mcmc")
    parser.add_argument("--test-every", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--ply", type=Path)
    parser.add_argument("--size", default="480x270")
    parser.add_argument("--passes", type=int, default=200)
    args = parser.parse_args()
    figures = train(args) if args.what == "train" else render(args)
    print(json.dumps({"trainer": "gsplat 1.5.3", "card": torch.cuda.get_device_name(), "scene": args.scene or args.capture.name} | figures))


if __name__ == "__main__":
    main()
