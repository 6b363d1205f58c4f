//! Options of pictures for people, moving ones among them.

use clap::Args;

use super::values::{newest, rate};

/// Moving pictures, and how pictures are drawn.
#[derive(Debug, Clone, Args)]
pub(crate) struct FilmArgs {
    /// Draw a film at so many pictures a second, along the cameras of one sensor's photos and between them, by the photos' times; one
    /// picture a camera where photos have no times. --out is a folder (000000.png and so on), a file that ends in .apng, or one that
    /// ends in .mp4, .webm, .mkv or .mov, for which ffmpeg has to be installed
    #[arg(long, value_name = "PER_SECOND", value_parser = rate)]
    pub(crate) sequence: Option<f64>,
    /// The sensor whose photos the film follows, where the capture has several
    #[arg(long, value_name = "NAME", requires = "sequence")]
    pub(crate) sensor: Option<String>,
    /// Mix each picture of a film with those before it, along the surfaces that they show, so that it flickers less: the share of the
    /// newest, in 0..1
    #[arg(long, value_name = "BETA", value_parser = newest, requires = "sequence")]
    pub(crate) smooth: Option<f64>,
    /// Tint the objects that move, each in its colour
    #[arg(long)]
    pub(crate) overlay: bool,
}
