#!/usr/bin/env bash
# Whether others read what `plat synth` writes: small captures of it, opened by pycolmap, the devkit of nuScenes,
# pykitti and Khronos' glTF validator. Fetches them into a folder of its own. PLAT names the program; without it, it is built.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
synth() { if [[ -n "${PLAT:-}" ]]; then "$PLAT" synth "$@"; else cargo run --release --locked -- synth "$@"; fi; }
synth --out "$scratch/city" --area-km2 0.05 --views 24 --size 96x54 --mesh --quiet
synth --out "$scratch/drives" --area-km2 0.02 --views 96 --aerial 0 --size 192x108 --spacing 8 --traffic heavy \
    --lidar --nuscenes --kitti-raw --truth --quiet

python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check pycolmap==4.2.1 nuscenes-devkit==1.2.0 \
    pykitti==0.3.1 opencv-python-headless
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
