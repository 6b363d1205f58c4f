//! Measures a model against the held-out photos of a capture.
//!
//! [`evaluate`] renders every held-out view once and compares it with its photo: PSNR, SSIM, SSIMULACRA2, LPIPS. On request it also
//! measures the depth, what a detector finds, the cuts of a level-of-detail tree ([`cuts`]) and the seams between blocks
//! ([`seams`]) on the same views.
//! [`Pruner`] prunes a model by a capture's photos, and [`update()`] trains an area of it on new ones. Contact sheets, error maps and bird's-eye cameras are here too.
//!
//! Architecture invariant: no command line, no terminal, no clock. Progress and time come from the caller's [`Observer`].

mod against_truth;
mod aligned;
mod birdseye;
mod budgets;
mod compared;
mod composition;
mod correlation;
mod depth;
mod details;
mod detections;
mod error;
mod evaluate;
mod figures;
mod fits;
mod groups;
mod held_out;
mod images;
mod judges;
mod label_colours;
mod lpips;
mod metric_maps;
mod moved;
mod moving;
mod networks;
mod normals;
mod observer;
mod photos;
mod picture;
mod pruning;
mod renderer;
mod sequence;
mod sheet;
mod shown_objects;
mod summary;
mod surface;
mod tracks;
mod update;
mod zone_pictures;
mod zones;

pub mod cuts;
pub mod seams;

pub use against_truth::AgainstTruth;
pub use aligned::AlignedLoss;
pub use birdseye::{birdseye_camera, oblique_camera};
pub use budgets::BudgetFigures;
pub use compared::side_by_side;
pub use composition::Composition;
pub use correlation::Correlation;
pub use depth::{DepthFigures, DepthSummary};
pub use details::{DetailOptions, Details, Levels};
pub use detections::{Correlations, DetectionFigures, DetectionSummary};
pub use error::EvalError;
pub use evaluate::{Evaluation, Request, evaluate};
pub use figures::{FIGURES, Means, ViewFigures, figures_from_frame, figures_to_frame, mean};
pub use fits::Fits;
pub use groups::{Groups, Kinds};
pub use held_out::figures_of_views;
pub use images::{frame_image, photo_image, write_png};
pub use judges::{DepthReport, DetectionReport};
pub use label_colours::{coloured_by, label_colour, painted};
pub use lpips::Lpips;
pub use moved::{FoundObjects, MovedFigures, MovedReport, moved};
pub use moving::{MovingFigures, ObjectFigures};
pub use networks::{DetectorFile, load_aligned, load_detector, load_identified_detector};
pub use observer::{Observer, Seconds};
pub use photos::{PhotoOptions, Photos};
pub use picture::Picture;
pub use pruning::Pruner;
pub use renderer::{Placed, Renderer, Uploaded};
pub use sequence::{Moment, TemporalFilter, camera_path};
pub use sheet::gallery;
pub use summary::{ByKind, Group, Summary};
pub use tracks::{TrackFigures, track_figures};
pub use update::{Gain, HALO, UpdateOptions, Updated, WorldBox, update};
pub use zone_pictures::{count_zones, draw_zones};
pub use zones::ZoneFigures;
