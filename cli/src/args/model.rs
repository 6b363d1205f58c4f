//! The command lines of `plat eval`, `render`, `prune`, `export`, `import` and `objects`.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use eval::{AlignedLoss, Levels, load_aligned};
use scene::BadInput;

use super::film::FilmArgs;
use super::values::{
    Backend, ObjectMove, Size, aligned_weight, clock_seconds, decibels, levels, metres, share, share_from_zero,
};
use super::zones::ZoneOptions;

#[derive(Debug, Clone, Default, Args)]
pub(crate) struct EvalArgs {
    /// Folder that `plat train` wrote, or a model as PLY, SPZ, SOG, streamed SOG, RAD or 3D Tiles
    pub(crate) model: PathBuf,
    /// Folder of the capture
    pub(crate) capture: PathBuf,
    /// Hold out every K-th view; by default as in the model's training, else 8
    #[arg(long, value_name = "K", value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) test_every: Option<u32>,
    /// Hold out whole stretches of streets, METRES wide; by default as in the model's training, else none
    #[arg(long, value_name = "METRES", value_parser = metres)]
    pub(crate) test_stretches: Option<f64>,
    /// Also measure N photos that were trained on, evenly chosen: what the model can show at best
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub(crate) trained: u32,
    /// Use photos at one N-th of their size; by default as in the model's training, else 1
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) downscale: Option<u32>,
    /// Backend to render the views on
    #[arg(long, value_enum, default_value = "auto")]
    pub(crate) backend: Backend,
    /// Folder for the contact sheet and the figures; by default OUT/eval for a folder that `plat train` wrote, NAME-eval beside a
    /// model NAME.ply or another
    #[arg(long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
    /// Store of the photos; by default the model's own if it exists, else a temporary one
    #[arg(long, value_name = "URL")]
    pub(crate) store: Option<String>,
    /// Also measure each view from the pose that fits its photo best, found against the model as it is. For captures whose
    /// poses have errors; by default if the model was trained with refined poses
    #[arg(long)]
    pub(crate) refine_poses: bool,
    /// Also measure the right half of each view after fitting an exposure to its left half; by default if the model was
    /// trained with exposures
    #[arg(long)]
    pub(crate) fit_exposure: bool,
    /// Also measure LPIPS with this network (ONNX)
    #[arg(long, value_name = "FILE", long_help = LPIPS_HELP)]
    pub(crate) lpips: Option<PathBuf>,
    /// Also measure the error of the rendered depth: against the true depth of a capture of plat synth --truth, else against the
    /// capture's lidar and metric depth maps
    #[arg(long)]
    pub(crate) depth: bool,
    /// Also measure how far what this detector (ONNX) finds on renders is what it finds on photos. Repeatable
    #[arg(long, value_name = "FILE", long_help = DETECTOR_HELP)]
    pub(crate) detector: Vec<PathBuf>,
    /// Also let the detectors look for the model's objects where they are SECONDS later on their paths, on held-out views
    #[arg(long, value_name = "SECONDS", allow_negative_numbers = true, value_parser = clock_seconds, requires = "detector")]
    pub(crate) objects_later: Option<f64>,
    /// Also measure the tree cut at level L, or at every level, against the finest model
    #[arg(long, value_name = "L|all", value_parser = levels)]
    pub(crate) level: Option<Levels>,
    /// Also measure what a viewer draws with at most N splats a view, against the whole model and against as many of its most important splats
    #[arg(long, value_name = "N,...", value_delimiter = ',', value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) budget: Vec<u32>,
    /// Also measure pixels near the faces between blocks against the other pixels of the same views, and the jump across each face
    #[arg(long)]
    pub(crate) seams: bool,
    /// As --seams, but at the faces of this model; for comparing a model of one block with a tree of the same capture
    #[arg(long, value_name = "MODEL")]
    pub(crate) seams_of: Option<PathBuf>,
    /// Distance within which a pixel is near a face; implies --seams. By default 2 metres if the capture has a geographic
    /// origin, but at most 1/8 of the edge of the smallest block; else 1/32 of that edge
    #[arg(long, value_name = "M", value_parser = metres)]
    pub(crate) seam_metres: Option<f64>,
}

pub(super) const DETECTOR_HELP: &str = "\
Also measure how far what this detector finds on renders is what it finds on photos: mean average precision, mean IoU,
misses and extra detections, figures of the zones where it finds something, and how these go with PSNR, SSIM and LPIPS.
For captures of plat synth also the precision against the true boxes. Repeatable.

An ONNX file of fixed sizes, as YOLOX (undecoded), YOLOv8, FastestDet or NanoDet export it. A file of the same name that
ends in .toml, beside it, can change how pictures go in and what comes out; these are the defaults of YOLOX:

    head = 'yolox'           # or 'yolov8', 'fastestdet', 'nanodet'; by default as the shapes tell
    strides = [8, 16, 32]
    resize = 'corner'        # or 'centre', both with grey around the picture; or 'stretch'
    channels = 'bgr'         # or 'rgb'
    mean = [0, 0, 0]         # the input is (level - mean) / std, levels of 255
    std = [1, 1, 1]
    pad = 114                # grey level around the picture, of 255
    score = 0.3              # of detections that count
    overlap = 0.45           # of boxes of a class, of which the best stays
    classes = ['person', 'bicycle', ...]  # those of COCO
    [map]                    # new names for classes; those with the same name become one
    bus = 'vehicle'

NanoDet's card also has bins and anchor. A key that would change nothing is refused.
";

const LPIPS_HELP: &str = "\
Also measure LPIPS with this network, an ONNX file with the weights inside: two inputs (1, 3, height, width) of sRGB
values in -1..1, one output, a number. The Python package lpips exports one (net='alex', as most papers):

    import lpips, torch
    x = torch.zeros(1, 3, 64, 64)
    free = {2: 'height', 3: 'width'}
    torch.onnx.export(lpips.LPIPS(net='alex').eval(), (x, x), 'lpips.onnx', input_names=['a', 'b'],
                      output_names=['distance'], dynamic_axes={'a': free, 'b': free}, dynamo=False)
";

#[derive(Debug, Clone, Args)]
pub(crate) struct RenderArgs {
    /// Folder that `plat train` wrote, or a model as PLY, SPZ, SOG, streamed SOG, RAD or 3D Tiles
    pub(crate) model: PathBuf,
    /// Cameras to render from: the folder of a capture, whose photos need not exist, or a transforms.json
    #[arg(long, value_name = "CAPTURE|FILE")]
    pub(crate) cameras: PathBuf,
    /// Folder for the pictures
    #[arg(long, value_name = "DIR")]
    pub(crate) out: PathBuf,
    /// Backend to render on
    #[arg(long, value_enum, default_value = "auto")]
    pub(crate) backend: Backend,
    /// Size of the pictures; by default that of each camera
    #[arg(long, value_name = "WxH")]
    pub(crate) size: Option<Size>,
    /// Colour splats by an integer attribute, such as block, instead of their own colours. A folder that `plat train` wrote always
    /// has block: the block that a splat belongs to
    #[arg(long, value_name = "ATTRIBUTE")]
    pub(crate) by: Option<String>,
    /// Draw the objects that move where they are at this time, seconds on the clock of their paths; by default when each camera's photo
    /// was taken
    #[arg(long, value_name = "T", value_parser = clock_seconds, allow_hyphen_values = true)]
    pub(crate) time: Option<f64>,
    /// Leave out the object of this name, or `all` of them; may be given several times
    #[arg(long, value_name = "ID", conflicts_with = "only")]
    pub(crate) without: Vec<String>,
    /// Draw the object of this name and nothing else; may be given several times
    #[arg(long, value_name = "ID")]
    pub(crate) only: Vec<String>,
    /// Draw the object of this name these metres beside its path, in the world, and turned by so many degrees to the left; may be given
    /// several times
    #[arg(long = "move", value_name = "ID=X,Y,Z[,DEGREES]", allow_hyphen_values = true)]
    pub(crate) moves: Vec<ObjectMove>,
    #[command(flatten)]
    pub(crate) film: FilmArgs,
    /// Also write depth as <view>.depth.npy: float32, metres along the optical axis, the harmonic mean over a pixel's splats, 0 = no surface
    #[arg(long, conflicts_with = "sequence")]
    pub(crate) depth: bool,
    /// Compensate opacity for the screen-space dilation; by default as the model says
    #[arg(long, overrides_with = "classic")]
    pub(crate) antialiased: bool,
    /// Render like the original 3DGS rasterizer; by default as the model says
    #[arg(long, overrides_with = "antialiased")]
    pub(crate) classic: bool,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct PruneArgs {
    /// Folder that `plat train` wrote, or a model as PLY, SPZ, SOG, streamed SOG, RAD or 3D Tiles
    pub(crate) model: PathBuf,
    /// Path of the pruned model: a folder if `plat train` wrote the model, else a file of the same format; .ply or .spz for others
    #[arg(long, value_name = "MODEL2")]
    pub(crate) out: PathBuf,
    /// Keep this share of the splats, in 0..1
    #[arg(long, value_name = "F", value_parser = share, conflicts_with = "tolerance_db")]
    pub(crate) keep: Option<f64>,
    /// Lose at most this much PSNR, dB, on every fourth of the views that are not held out; only the last recovery trains on these; 0.1 if --keep is not given either [needs --capture]
    #[arg(long, value_name = "X", value_parser = decibels)]
    pub(crate) tolerance_db: Option<f64>,
    /// Lose at most this share of the objects that --detector finds both on photos and on the model's renders of the views that
    /// judge, 0..1; by default any. For small shares, and on few photos, it ends pruning early
    #[arg(long, value_name = "F", value_parser = share_from_zero, requires = "zone_detector", conflicts_with = "keep")]
    pub(crate) tolerance_detections: Option<f64>,
    /// Capture whose photos splats are ranked and recovered by; without it only --keep, ranked by opacity and size
    #[arg(long)]
    pub(crate) capture: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) photos: PruneCapture,
}

/// How the photos of the capture are read.
#[derive(Debug, Clone, Args)]
pub(crate) struct PruneCapture {
    /// Hold out every K-th view; by default as in the model's training, else 8
    #[arg(long, value_name = "K")]
    pub(crate) test_every: Option<u32>,
    /// Use photos at one N-th of their size; by default as in the model's training, else 1
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) downscale: Option<u32>,
    /// Store of the photos; by default the model's own if it exists, else a temporary one
    #[arg(long, value_name = "URL")]
    pub(crate) store: Option<String>,
    #[command(flatten)]
    pub(crate) zones: ZoneOptions,
    /// Weight of the perception-aligned loss in recoveries: what --detector sees in renders shall be what it sees in the photos. From 0,
    /// the default, which leaves it out, to 1000; at 0.003 fewer objects are missed, for more CPU time and 0.1 dB
    #[arg(long, value_name = "A", value_parser = aligned_weight, requires = "zone_detector")]
    pub(crate) aligned_weight: Option<f64>,
}

impl PruneCapture {
    /// The perception-aligned loss and its weight, if it has one.
    ///
    /// # Errors
    /// A detector that cannot be read, or that has no gradient.
    pub(crate) fn aligned(&self) -> Result<Option<(AlignedLoss, f32)>, BadInput> {
        let weight = self.aligned_weight.filter(|weight| *weight > 0.0);
        let with_weight = self.zones.finder.zone_detector.as_deref().zip(weight);
        with_weight.map(|(path, weight)| Ok((load_aligned(path)?, weight as f32))).transpose()
    }
}

/// A format that other programs read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Format {
    /// INRIA's PLY, which most viewers and trainers read
    Ply,
    /// Niantic's SPZ, version 3: a tenth of the size, quantised
    Spz,
    /// A folder of streamed SOG, the format of PlayCanvas and SuperSplat, with the model's levels of detail
    Sog,
    /// RAD, one file that Spark streams: a tree of levels of detail above the model's finest splats
    Rad,
    /// A folder of 3D Tiles with splats in glTF, which CesiumJS streams, with the model's levels of detail
    Tiles,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct ExportArgs {
    /// Folder that `plat train` wrote, or a model as PLY, SPZ, SOG, streamed SOG, RAD or 3D Tiles
    pub(crate) model: PathBuf,
    /// Format
    #[arg(long, value_enum)]
    pub(crate) to: Format,
    /// File to write; for sog and tiles a new folder
    #[arg(long, value_name = "PATH")]
    pub(crate) out: PathBuf,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct ImportArgs {
    /// Model as PLY, SPZ, SOG (.sog or meta.json), streamed SOG (lod-meta.json), RAD or 3D Tiles (tileset.json), or the folder that it
    /// lies in
    pub(crate) model: PathBuf,
    /// File to write: .ply, or .spz, which rounds
    #[arg(long, value_name = "FILE")]
    pub(crate) out: PathBuf,
}
