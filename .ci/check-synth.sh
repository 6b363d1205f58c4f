#!/usr/bin/env bash
# Whether others read what `plat synth` writes: small captures of it, opened by pycolmap, the devkit of nuScenes,
# pykitti, pyarrow with the components of Waymo's devkit, and Khronos' glTF validator. Fetches them into a folder of its own. PLAT names the program; without it, it is built.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
synth() { if [[ -n "${PLAT:-}" ]]; then "$PLAT" synth "$@"; else cargo run --release --locked -- synth "$@"; fi; }
synth --out "$scratch/city" --area-km2 0.05 --views 24 --size 96x54 --mesh --quiet
synth --out "$scratch/drives" --area-km2 0.02 --views 96 --aerial 0 --size 192x108 --spacing 8 --traffic heavy \
    --lidar --nuscenes --kitti-raw --waymo --truth --quiet

python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check pycolmap==4.2.1 nuscenes-devkit==1.2.0 \
    pykitti==0.3.1 opencv-python-headless pyarrow==18.1.0
"$scratch/venv/bin/python" - "$scratch/city" <<'PYTHON'
import json, pathlib, sys
import pycolmap

city = pathlib.Path(sys.argv[1])
model = pycolmap.Reconstruction(str(city / "sparse/0"))
told = json.loads((city / "manifest.json").read_text())["summary"]
assert model.num_images() == told["views"], (model.num_images(), told)
assert model.num_points3D() == told["points"], (model.num_points3D(), told)
assert abs(model.compute_mean_track_length() - told["mean_track"]) < 1e-6, told
for image in model.images.values():
    assert (city / "images" / image.name).is_file(), image.name
for point in model.points3D.values():
    for element in point.track.elements:
        at = model.images[element.image_id].project_point(point.xyz)
        assert at is not None, "a point behind a camera that saw it"
print("pycolmap:", model.summary().replace("\n", " "))
PYTHON

# The devkit's cameras are COLMAP's, and its returns lie where the photos' true depths are.
"$scratch/venv/bin/python" - "$scratch/drives" <<'PYTHON'
import pathlib, sys
import numpy, pycolmap
from nuscenes.nuscenes import NuScenes, NuScenesExplorer
from pyquaternion import Quaternion

city = pathlib.Path(sys.argv[1])
data = NuScenes(version="v1.0-mini", dataroot=str(city / "nuscenes"), verbose=False)
model = pycolmap.Reconstruction(str(city / "sparse/0"))
cameras = {pathlib.Path(image.name).stem: image for image in model.images.values()}
photos, sweeps, off, errors = 0, 0, 0.0, []
for row in data.sample_data:
    mounted = data.get("calibrated_sensor", row["calibrated_sensor_token"])
    vehicle = data.get("ego_pose", row["ego_pose_token"])
    assert (city / "nuscenes" / row["filename"]).is_file(), row["filename"]
    if row["sensor_modality"] == "lidar":
        sweeps += 1
        continue
    photos += 1
    image = cameras[pathlib.Path(row["filename"]).stem]
    turn, place = Quaternion(vehicle["rotation"]), numpy.array(vehicle["translation"])
    centre = place + turn.rotate(numpy.array(mounted["translation"]))
    world_from_camera = (turn * Quaternion(mounted["rotation"])).rotation_matrix
    ours = image.cam_from_world().matrix()
    off = max(off, abs(centre + ours[:, :3].T @ ours[:, 3]).max(), abs(world_from_camera.T - ours[:, :3]).max())
    matrix = image.camera.calibration_matrix()
    off = max(off, abs(matrix - numpy.array(mounted["camera_intrinsic"])).max())
explorer = NuScenesExplorer(data)
for sample in data.sample:
    if "LIDAR_TOP" not in sample["data"]:
        continue
    for channel, camera in sample["data"].items():
        if not channel.startswith("CAM_"):
            continue
        points, depths, _ = explorer.map_pointcloud_to_image(sample["data"]["LIDAR_TOP"], camera)
        truth = numpy.load(city / f"depth/{pathlib.Path(data.get('sample_data', camera)['filename']).stem}.npy")
        x, y = points[0].astype(int), points[1].astype(int)
        true = truth[y, x]
        errors.extend(abs(depths[true > 0] / true[true > 0] - 1))
median = float(numpy.median(errors))
print(f"nuScenes devkit: {len(data.scene)} scenes, {photos} photos, {sweeps} sweeps,",
      f"{len(data.sample_annotation)} boxes; cameras within {off:.1e} of COLMAP's, {len(errors)} returns, depths off by {100 * median:.2f} % (median)")
assert photos == model.num_images() and sweeps > 0 and len(data.sample_annotation) > 0
assert off < 1e-4 and len(errors) > 1000 and median < 0.02
PYTHON

# pykitti's cameras are COLMAP's, in a world whose origin is the first frame of the drive.
"$scratch/venv/bin/python" - "$scratch/drives" <<'PYTHON'
import pathlib, sys
import numpy, pycolmap, pykitti

city = pathlib.Path(sys.argv[1])
model = pycolmap.Reconstruction(str(city / "sparse/0"))
cameras = {pathlib.Path(image.name).stem: image for image in model.images.values()}
photos, sweeps, off = 0, 0, 0.0
for folder in sorted((city / "kitti_raw/1970_01_01").glob("*_sync")):
    leg = folder.name.split("_")[-2]
    drive = pykitti.raw(str(city / "kitti_raw"), "1970_01_01", leg)
    calibration, origin = drive.calib, None
    for side, files, camera in ("left", drive.cam2_files, calibration.T_cam2_imu), ("right", drive.cam3_files, calibration.T_cam3_imu):
        taken = sorted(name for name in cameras if name.startswith(f"street-front-{side}-{leg}-"))
        assert len(taken) == len(files), (folder, len(taken), len(files))
        for file, name in zip(files, taken):
            ours = drive.oxts[int(pathlib.Path(file).stem)].T_w_imu @ numpy.linalg.inv(camera)
            theirs = cameras[name].cam_from_world().matrix()
            centre = -theirs[:, :3].T @ theirs[:, 3]
            origin = centre - ours[:3, 3] if origin is None else origin
            off = max(off, abs(ours[:3, 3] + origin - centre).max(), abs(ours[:3, :3].T - theirs[:, :3]).max())
            photos += 1
    sweeps += len(drive.velo_files)
print(f"pykitti: {photos} photos, {sweeps} sweeps; cameras within {off:.1e} of COLMAP's")
assert photos > 0 and sweeps > 0 and off < 1e-4
PYTHON

# Waymo's devkit says which columns there are; its formulas give the cameras of COLMAP, and returns where the true depths are. plat
# then reads the same tables as pyarrow writes them: compressed, with dictionaries, in groups of rows.
"$scratch/venv/bin/pip" download --quiet --disable-pip-version-check --no-deps --dest "$scratch" waymo-open-dataset-tf-2-12-0==1.6.7
"$scratch/venv/bin/python" -m zipfile -e "$scratch"/waymo_open_dataset*.whl "$scratch/devkit"
"$scratch/venv/bin/python" - "$scratch/drives" "$scratch/devkit" "$scratch/packed" <<'PYTHON'
import io, json, pathlib, sys, types
import numpy, pyarrow, pycolmap
import pyarrow.parquet as parquet
from PIL import Image

city, devkit, packed = map(pathlib.Path, sys.argv[1:])
# Its components alone: the rest of the package needs tensorflow, which they name in a hint of types.
sys.modules["tensorflow"] = types.SimpleNamespace(Tensor=object)
for name in ("waymo_open_dataset", "waymo_open_dataset.v2", "waymo_open_dataset.v2.perception"):
    sys.modules[name] = types.ModuleType(name)
    sys.modules[name].__path__ = [str(devkit / name.replace(".", "/"))]
from waymo_open_dataset.v2.perception import box, camera_image, context, lidar, pose

COMPONENTS = {
    "camera_calibration": context.CameraCalibrationComponent, "camera_image": camera_image.CameraImageComponent,
    "vehicle_pose": pose.VehiclePoseComponent, "lidar_calibration": context.LiDARCalibrationComponent,
    "lidar": lidar.LiDARComponent, "lidar_pose": lidar.LiDARPoseComponent, "lidar_box": box.LiDARBoxComponent,
    "stats": context.StatsComponent,
}
MOUNTS = {"FRONT_LEFT": "front-left", "FRONT_RIGHT": "front-right", "SIDE_LEFT": "left", "SIDE_RIGHT": "right"}


def plain(kind):
    """The type of a column, for which a list of a fixed length is a list."""
    return ("list", kind.value_type) if hasattr(kind, "value_type") else kind


def matrix(transform):
    return numpy.array(transform.transform).reshape(4, 4)


def turned(roll, pitch, yaw):
    (a, b, c), (d, e, f) = (map(wave, (roll, pitch, yaw)) for wave in (numpy.cos, numpy.sin))
    rows = [c * b, c * e * d - f * a, c * e * a + f * d, f * b, f * e * d + c * a, f * e * a - c * d, -e, b * d, b * a]
    return numpy.stack(rows, -1).reshape(*roll.shape, 3, 3)


def places(turn, laser, poses):
    """World places of a range image, as the devkit computes them, and which pixels have a return."""
    image = numpy.array(turn.range_image_return1.values).reshape(turn.range_image_return1.shape)
    height, width = image.shape[:2]
    mounted, beams = matrix(laser.extrinsic), numpy.array(laser.beam_inclination.values)[::-1]
    azimuth = ((numpy.arange(width, 0, -1) - 0.5) / width * 2 - 1) * numpy.pi - numpy.arctan2(mounted[1, 0], mounted[0, 0])
    ray = [numpy.cos(azimuth) * numpy.cos(beams)[:, None], numpy.sin(azimuth) * numpy.cos(beams)[:, None],
           numpy.broadcast_to(numpy.sin(beams)[:, None], (height, width))]
    points = numpy.stack(ray, -1) * image[..., :1] @ mounted[:3, :3].T + mounted[:3, 3]
    poses = numpy.array(poses.range_image_return1.values).reshape(poses.range_image_return1.shape)
    rotations = turned(*numpy.moveaxis(poses[..., :3], -1, 0))
    return (numpy.einsum("hwij,hwj->hwi", rotations, points) + poses[..., 3:])[image[..., 0] > 0]


model = pycolmap.Reconstruction(str(city / "sparse/0"))
cameras = {pathlib.Path(image.name).stem: image for image in model.images.values()}
# x ahead, y left, z up to x right, y down, z ahead.
axes = numpy.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
photos, sweeps, off, errors, told, found = 0, 0, 0.0, [], 0, 0
segments = sorted(path.stem for path in (city / "waymo/camera_image").iterdir())
for segment in segments:
    rows = {}
    for name, component in COMPONENTS.items():
        table = parquet.read_table(city / f"waymo/{name}/{segment}.parquet")
        wanted = component.schema()
        assert {f.name: plain(f.type) for f in table.schema} == {f.name: plain(f.type) for f in wanted}, name
        rows[name] = [component.from_dict(row) for row in table.to_pylist()]
        # As the owners' files are: compressed, with dictionaries, in groups of rows.
        columns = [column.cast(wanted.field(key).type) for key, column in zip(table.column_names, table.columns) if not key.endswith("return2.shape")]
        names = [key for key in table.column_names if not key.endswith("return2.shape")]
        for codec in ("brotli", "snappy"):
            (packed / codec / name).mkdir(parents=True, exist_ok=True)
            parquet.write_table(pyarrow.table(columns, names), packed / codec / name / f"{segment}.parquet", compression=codec, row_group_size=7)
    lenses = {row.key.camera_name: row for row in rows["camera_calibration"]}
    taken = {}
    for camera, mount in MOUNTS.items():
        camera = camera_image.CameraName[camera].value
        shots = sorted(name for name in cameras if name.startswith(f"street-{mount}-{segment[-4:]}-"))
        own = sorted((row for row in rows["camera_image"] if row.key.camera_name == camera), key=lambda row: row.key.frame_timestamp_micros)
        assert len(shots) == len(own) > 0, (segment, mount)
        for row, name in zip(own, shots):
            image, lens = cameras[name], lenses[camera]
            world_from_camera = matrix(row.pose) @ matrix(lens.extrinsic)
            ours = image.cam_from_world().matrix()
            off = max(off, abs(world_from_camera[:3, 3] + ours[:, :3].T @ ours[:, 3]).max(), abs(axes @ world_from_camera[:3, :3].T - ours[:, :3]).max())
            k = lens.intrinsic
            off = max(off, abs(image.camera.calibration_matrix() - [[k.f_u, 0, k.c_u], [0, k.f_v, k.c_v], [0, 0, 1]]).max())
            photo = Image.open(io.BytesIO(row.image))
            assert photo.format == "JPEG" and photo.size == (lens.width, lens.height)
            taken.setdefault(row.key.frame_timestamp_micros, []).append((name, lens, numpy.linalg.inv(world_from_camera)))
            photos += 1
    [laser], vehicles = rows["lidar_calibration"], {row.key: matrix(row.world_from_vehicle) for row in rows["vehicle_pose"]}
    poses = {row.key: row for row in rows["lidar_pose"]}
    for turn in rows["lidar"]:
        world, time = places(turn, laser, poses[turn.key]), turn.key.frame_timestamp_micros
        sweeps += 1
        for name, lens, camera_from_world in taken[time]:
            x, y, z = (world @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]).T
            ahead = x > 1
            u, v = (lens.intrinsic.c_u - lens.intrinsic.f_u * y[ahead] / x[ahead], lens.intrinsic.c_v - lens.intrinsic.f_v * z[ahead] / x[ahead])
            inside = (u >= 0) & (u < lens.width) & (v >= 0) & (v < lens.height)
            true = numpy.load(city / f"depth/{name}.npy")[v[inside].astype(int), u[inside].astype(int)]
            errors.extend(abs(x[ahead][inside][true > 0] / true[true > 0] - 1))
        vehicle = next(pose for key, pose in vehicles.items() if key.frame_timestamp_micros == time)
        for label in (row for row in rows["lidar_box"] if row.key.frame_timestamp_micros == time and row.num_lidar_points_in_box > 0):
            local = (world - vehicle[:3, 3]) @ vehicle[:3, :3] - label.box.center.numpy
            c, s = numpy.cos(label.box.heading), numpy.sin(label.box.heading)
            local = local @ numpy.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
            # Half a turn takes 25 ms, in which a car moves by up to 0.3 m.
            inside = (abs(local) < label.box.size.numpy / 2 + 0.4).all(1).sum()
            told, found = told + 1, found + (2 * inside >= label.num_lidar_points_in_box)
median = float(numpy.median(errors))
print(f"Waymo's components, read by pyarrow: {len(segments)} segments, {photos} photos, {sweeps} sweeps; cameras within {off:.1e} of COLMAP's,",
      f"{len(errors)} returns, depths off by {100 * median:.2f} % (median), {found} of {told} boxes hold their returns")
assert photos > 0 and sweeps > 0 and off < 1e-4 and len(errors) > 1000 and median < 0.02 and told > 0 and found >= 0.95 * told
PYTHON
inspect() { if [[ -n "${PLAT:-}" ]]; then "$PLAT" inspect "$@"; else cargo run --release --locked -- inspect "$@"; fi; }
tables=("$scratch"/drives/waymo/camera_image/*.parquet)
segment=$(basename "${tables[0]}" .parquet)
for folder in "$scratch/drives/waymo" "$scratch/packed/brotli" "$scratch/packed/snappy"; do
    inspect "$folder/$segment" --json --quiet | tail -1 |
        python3 -c 'import json, sys; found = json.load(sys.stdin); print([found[key] for key in ("format", "views", "sizes", "masked", "points", "sweeps", "views_with_lidar", "lidar_points", "boxes", "extent_metres")])'
done | sort | uniq -c | tee "$scratch/inspected"
grep -q "^ *3 " "$scratch/inspected" || { echo "plat reads a segment and its repacked copies differently" >&2; exit 1; }

npm install --silent --no-audit --no-fund --prefix "$scratch/npm" gltf-validator@2.0.0-dev.3.10
NODE_PATH="$scratch/npm/node_modules" node - "$scratch/city/city.glb" <<'NODE'
const validator = require('gltf-validator');
const bytes = new Uint8Array(require('fs').readFileSync(process.argv[2]));
validator.validateBytes(bytes, { maxIssues: 0 }).then(({ issues, info }) => {
  const { numErrors, numWarnings, numInfos, numHints, messages } = issues;
  for (const message of messages.filter(({ severity }) => severity < 2)) console.log(message);
  console.log(`glTF: ${numErrors} errors, ${numWarnings} warnings, ${numInfos} infos, ${numHints} hints;`,
    `${info.totalTriangleCount} triangles`);
  process.exitCode = numErrors > 0 ? 1 : 0;
});
NODE
