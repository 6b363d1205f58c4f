//! The CPU backend: SIMD kernels selected at run time, rayon over chunks of splats and rows of tiles.
//!
//! Data flow of a view; every arrow is an array:
//! ```text
//! splats ─project→ records ─sort→ order ─bin→ pairs per tile ─rasterize→ frame
//! upstream ─rasterize_backward→ moments per pair ─reduce→ moments per splat ─project_backward→ gradients
//! ```
//! Every reduction runs in the order of the data, so results do not depend on the number of threads. `with_max_len(1)`
//! makes threads take one chunk or tile row at a time: rayon's default split into a few large ranges balances the load
//! badly.

mod bin;
pub mod ceiling;
mod contributions;
mod counting_sort;
mod intermediates;
mod project;
mod project_backward;
mod rasterize;
mod rasterize_backward;
mod sh;
pub mod simd;
mod tile;

use rayon::prelude::*;
use scene::{Camera, Splats};

use crate::{Contributions, Frame, Gradients, Options, Part, Upstream};
use bin::{Bins, SortScratch, TILE};
use project::{Projected, View};
use project_backward::GradientChunk;
use rasterize::{Band, Visited};
use rasterize_backward::BackwardBand;
pub use simd::Isa;
use simd::prefetch;
use tile::{Moments, PREFETCH_DISTANCE, TileInput};

/// Splats per parallel chunk; a multiple of [`simd::LANES`].
const CHUNK: usize = 1024;

/// A stage of the forward or backward pass, see the [module](self).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum Stage {
    Project,
    Sort,
    Bin,
    Rasterize,
    RasterizeBackward,
    Reduce,
    ProjectBackward,
}

impl Stage {
    /// All stages in order.
    pub const ALL: [Self; 7] = [
        Self::Project,
        Self::Sort,
        Self::Bin,
        Self::Rasterize,
        Self::RasterizeBackward,
        Self::Reduce,
        Self::ProjectBackward,
    ];

    /// The stage's name in every backend.
    pub fn name(self) -> &'static str {
        match self {
            Self::Project => "project",
            Self::Sort => "sort",
            Self::Bin => "bin",
            Self::Rasterize => "rasterize",
            Self::RasterizeBackward => "rasterize_backward",
            Self::Reduce => "reduce",
            Self::ProjectBackward => "project_backward",
        }
    }
}

/// A renderer that reuses its buffers from view to view.
#[derive(Debug)]
pub struct Renderer {
    isa: Isa,
    records: Vec<Projected>,
    seen: Vec<u16>,
    order: Vec<u32>,
    sort: SortScratch,
    ranked: Vec<Projected>,
    bins: Bins,
    visited: Vec<Visited>,
    moments: Vec<Moments>,
    /// Rank of each splat in depth order; defined for visible splats only.
    rank: Vec<u32>,
    sums: Vec<Moments>,
    gradients: Gradients,
    contributions: Contributions,
    frame: Frame,
    /// View, options and number of trainable splats of the last `forward`.
    last_forward: Option<(View, Options, usize)>,
}

impl Default for Renderer {
    fn default() -> Self {
        Self::new(Isa::detect())
    }
}

impl Renderer {
    /// A renderer on this instruction set.
    pub fn new(isa: Isa) -> Self {
        Self {
            isa,
            records: Vec::new(),
            seen: Vec::new(),
            order: Vec::new(),
            sort: SortScratch::default(),
            ranked: Vec::new(),
            bins: Bins::default(),
            visited: Vec::new(),
            moments: Vec::new(),
            rank: Vec::new(),
            sums: Vec::new(),
            gradients: Gradients::default(),
            contributions: Contributions::default(),
            frame: Frame::default(),
            last_forward: None,
        }
    }

    /// The backend's name: "cpu-avx512", "cpu-avx2" or "cpu-portable".
    pub fn name(&self) -> String {
        format!("cpu-{}", self.isa.name())
    }

    /// Draws the trainable splats together with frozen parts. The camera is in the axes of the trainable splats.
    pub fn forward(&mut self, splats: &Splats, parts: &[Part], camera: &Camera, options: &Options) -> &Frame {
        self.forward_timed(splats, parts, camera, options, &mut |_| ())
    }

    /// As [`forward`](Self::forward); calls `done` after each stage, for timing.
    pub fn forward_timed(
        &mut self,
        splats: &Splats,
        parts: &[Part],
        camera: &Camera,
        options: &Options,
        done: &mut dyn FnMut(Stage),
    ) -> &Frame {
        let options = Options { sh_degree: options.sh_degree.min(splats.sh_degree()), ..*options };
        let view = View::new(camera);
        self.last_forward = Some((view, options, splats.len()));
        self.project(splats, parts, camera, &options);
        done(Stage::Project);
        bin::sort_by_depth(&self.records, &self.seen, &mut self.order, &mut self.sort);
        self.ranked.resize(self.order.len(), Projected::default());
        self.ranked.par_chunks_mut(CHUNK).zip(self.order.par_chunks(CHUNK)).for_each(|(ranked, order)| {
            for (ranked, &i) in ranked.iter_mut().zip(order) {
                *ranked = self.records[i as usize];
                // The rasterizers blend what is in the place of the depth.
                if options.inverse_depth {
                    ranked.0[project::at::Z] = 1.0 / ranked.0[project::at::Z];
                }
            }
        });
        done(Stage::Sort);
        let (width, height) = (camera.pinhole.width as usize, camera.pinhole.height as usize);
        bin::bin(self.isa, &self.ranked, width, height, &mut self.bins);
        done(Stage::Bin);
        self.rasterize(width, height, &options);
        done(Stage::Rasterize);
        &self.frame
    }

    /// The frame of the last [`forward`](Self::forward).
    pub fn frame(&self) -> &Frame {
        &self.frame
    }

    /// Gradients of the trainable splats of the last [`forward`](Self::forward). `splats` must be those of the forward
    /// pass, unchanged.
    ///
    /// # Panics
    /// Without a forward pass before, or with another number of splats.
    pub fn backward(&mut self, splats: &Splats, upstream: &Upstream) -> &mut Gradients {
        self.backward_timed(splats, upstream, &mut |_| ())
    }

    /// As [`backward`](Self::backward); calls `done` after each stage, for timing.
    ///
    /// # Panics
    /// As `backward`.
    pub fn backward_timed(
        &mut self,
        splats: &Splats,
        upstream: &Upstream,
        done: &mut dyn FnMut(Stage),
    ) -> &mut Gradients {
        let (view, options, count) = self.last_forward.expect("backward follows forward");
        assert_eq!(count, splats.len(), "backward needs the splats of the forward pass");
        self.rasterize_backward(upstream);
        done(Stage::RasterizeBackward);
        self.reduce(count);
        done(Stage::Reduce);
        self.project_backward(splats, &view, &options);
        done(Stage::ProjectBackward);
        &mut self.gradients
    }

    /// The gradients of the last [`backward`](Self::backward).
    pub fn gradients(&self) -> &Gradients {
        &self.gradients
    }

    /// Number of (splat, tile) pairs of the last view; the rasterizer's time is roughly proportional to it.
    pub fn pairs(&self) -> usize {
        self.bins.pairs.len()
    }

    /// Number of (splat, 4×4 pixel block) combinations that the rasterizer evaluated in the last view, for counting its
    /// operations. The backward pass evaluates the same ones.
    pub fn visits(&self) -> u64 {
        self.visited.iter().map(|tile| u64::from(tile.blocks)).sum()
    }

    fn project(&mut self, splats: &Splats, parts: &[Part], camera: &Camera, options: &Options) {
        // Records of every part start at a multiple of LANES.
        let padded = |splats: &Splats| splats.len().next_multiple_of(simd::LANES);
        let total = padded(splats) + parts.iter().map(|part| padded(part.splats)).sum::<usize>();
        self.records.resize(total, Projected::default());
        self.seen.clear();
        self.seen.resize(total / simd::LANES, 0);
        let isa = self.isa;
        let (mut records, mut seen) = (self.records.as_mut_slice(), self.seen.as_mut_slice());
        let mut draw = |splats: &Splats, camera: &Camera, options: &Options, trainable: f32| {
            let view = View::new(camera);
            let (of_records, rest) = std::mem::take(&mut records).split_at_mut(padded(splats));
            records = rest;
            let (of_seen, rest) = std::mem::take(&mut seen).split_at_mut(padded(splats) / simd::LANES);
            seen = rest;
            of_records[..splats.len()]
                .par_chunks_mut(CHUNK)
                .zip(of_seen.par_chunks_mut(CHUNK / simd::LANES))
                .enumerate()
                .with_max_len(1)
                .for_each(|(chunk, (records, seen))| {
                    project::project(isa, splats, chunk * CHUNK, &view, options, trainable, records, seen);
                });
        };
        draw(splats, camera, options, 1.0);
        for Part { splats, camera_from_part } in parts {
            // Frozen splats are drawn at their full SH degree, whatever degree training has reached.
            let options = Options { sh_degree: splats.sh_degree(), ..*options };
            let camera_from_world = camera_from_part.unwrap_or(camera.camera_from_world);
            draw(splats, &Camera { camera_from_world, ..*camera }, &options, 0.0);
        }
    }

    fn rasterize(&mut self, width: usize, height: usize, options: &Options) {
        let area = width * height;
        let frame = &mut self.frame;
        (frame.width, frame.height) = (width, height);
        frame.colour.resize(3 * area, 0.0);
        frame.transmittance.resize(area, 0.0);
        let extra = if options.extras { area } else { 0 };
        frame.depth.resize(extra, 0.0);
        frame.trainable_alpha.resize(extra, 0.0);

        let rows = TILE * width;
        let mut colour = frame.colour.chunks_mut(area.max(1)).map(|plane| plane.chunks_mut(rows));
        let mut next_colour = || colour.next().expect("three colour planes");
        let (red, green, blue) = (next_colour(), next_colour(), next_colour());
        let mut depth = frame.depth.chunks_mut(rows);
        let mut trainable_alpha = frame.trainable_alpha.chunks_mut(rows);
        self.visited.resize(self.bins.tiles_x * self.bins.tiles_y, Visited::default());
        let bands: Vec<_> = (red.zip(green).zip(blue).zip(frame.transmittance.chunks_mut(rows)))
            .map(|(((red, green), blue), transmittance)| Band {
                colour: [red, green, blue],
                transmittance,
                depth: depth.next().unwrap_or_default(),
                trainable_alpha: trainable_alpha.next().unwrap_or_default(),
            })
            .collect();
        let (bins, ranked, isa) = (&self.bins, &self.ranked, self.isa);
        bands.into_par_iter().zip(self.visited.par_chunks_mut(bins.tiles_x)).enumerate().with_max_len(1).for_each(
            |(row, (mut band, visited))| {
                for (column, visited) in visited.iter_mut().enumerate() {
                    let tile = row * bins.tiles_x + column;
                    let pairs = &bins.pairs[bins.start[tile] as usize..bins.start[tile + 1] as usize];
                    let input = TileInput { ranked, pairs, x: column * TILE, y: row * TILE, width, height };
                    *visited = rasterize::rasterize(isa, &input, &options.background, options.extras, &mut band);
                }
            },
        );
    }

    fn rasterize_backward(&mut self, upstream: &Upstream) {
        let (frame, isa) = (&self.frame, self.isa);
        self.bins.for_each_tile(
            &self.ranked,
            &self.visited,
            &mut self.moments,
            frame.width,
            frame.height,
            |row, tile, out| {
                rasterize_backward::rasterize_backward(isa, tile, &BackwardBand::new(frame, upstream, row), out);
            },
        );
    }

    /// Sums the moments of each splat's pairs, in the order of its tiles. Splats are processed in depth order, which is
    /// the order of the emission numbers: then only the moments are gathered from scattered positions, and these are
    /// known ahead for prefetching.
    fn reduce(&mut self, count: usize) {
        self.rank_splats();
        self.sums.resize(self.order.len(), Moments::default());
        let (bins, order, moments) = (&self.bins, &self.order, &self.moments);
        self.sums.par_chunks_mut(CHUNK).enumerate().with_max_len(1).for_each(|(chunk, sums)| {
            let first = chunk * CHUNK;
            for (rank, sum) in (first..).zip(sums).filter(|(rank, _)| (order[*rank] as usize) < count) {
                let mut total = [0.0f32; 16];
                let pairs = bins.emitted[rank] as usize..bins.emitted[rank + 1] as usize;
                for pair in pairs {
                    let ahead = bins
                        .position
                        .get(pair + PREFETCH_DISTANCE)
                        .and_then(|&position| moments.get(position as usize));
                    ahead.into_iter().for_each(prefetch);
                    for (total, value) in total.iter_mut().zip(&moments[bins.position[pair] as usize].0) {
                        *total += value;
                    }
                }
                *sum = Moments(total);
            }
        });
    }

    /// Fills `rank`, the inverse of `order`.
    fn rank_splats(&mut self) {
        self.rank.resize(self.records.len(), 0);
        for (rank, &i) in self.order.iter().enumerate() {
            self.rank[i as usize] = rank as u32;
        }
    }

    fn project_backward(&mut self, splats: &Splats, view: &View, options: &Options) {
        let n = splats.len();
        let out = &mut self.gradients;
        out.columns.resize(splats.columns().len(), Vec::new());
        for column in
            out.columns.iter_mut().chain([&mut out.screen_gradient, &mut out.screen_gradient_abs, &mut out.weight])
        {
            column.resize(n, 0.0);
        }
        let words = n.div_ceil(simd::LANES);
        out.seen.clear();
        out.seen.extend_from_slice(&self.seen[..words]);
        // Columns of coefficients above the degree in use are not written.
        let used = scene::column::SH + 3 * scene::splats::sh_coefficients(options.sh_degree);
        let mut chunks: Vec<GradientChunk> = (out
            .screen_gradient
            .chunks_mut(CHUNK)
            .zip(out.screen_gradient_abs.chunks_mut(CHUNK))
            .zip(out.weight.chunks_mut(CHUNK)))
        .map(|((screen_gradient, screen_gradient_abs), weight)| GradientChunk {
            columns: Vec::with_capacity(used),
            screen_gradient,
            screen_gradient_abs,
            weight,
        })
        .collect();
        for column in &mut out.columns[..used] {
            for (chunk, column) in chunks.iter_mut().zip(column.chunks_mut(CHUNK)) {
                chunk.columns.push(column);
            }
        }
        let (isa, seen, sums, rank) = (self.isa, &self.seen, &self.sums, &self.rank);
        let cameras: Vec<[f32; 7]> = (chunks.par_iter_mut().enumerate().with_max_len(1))
            .map(|(n_chunk, chunk)| {
                let first = n_chunk * CHUNK;
                let rank = &rank[first..(first + CHUNK).min(n)];
                let seen = &seen[first / simd::LANES..];
                project_backward::project_backward(isa, splats, first, view, options, seen, rank, sums, chunk)
            })
            .collect();
        (out.pose, out.focal) = ([0.0; 6], 0.0);
        for [pose @ .., focal] in cameras {
            out.pose.iter_mut().zip(pose).for_each(|(total, part)| *total += part);
            out.focal += focal;
        }
    }
}

impl Bins {
    /// Calls `work(tile row, tile, moments)` for every tile, in parallel over tile rows. `moments` are those of the
    /// pairs that the forward pass visited; the moments of the tile's other pairs are set to zero.
    fn for_each_tile(
        &self,
        ranked: &[Projected],
        visited: &[Visited],
        moments: &mut Vec<Moments>,
        width: usize,
        height: usize,
        work: impl Fn(usize, &TileInput, &mut [Moments]) + Sync,
    ) {
        moments.resize(self.pairs.len(), Moments::default());
        // The pairs of a tile row are contiguous, so tile rows write disjoint slices.
        let mut rest = moments.as_mut_slice();
        let mut bands = Vec::with_capacity(self.tiles_y);
        for row in 0..self.tiles_y {
            let len = self.start[(row + 1) * self.tiles_x] - self.start[row * self.tiles_x];
            let (band, after) = rest.split_at_mut(len as usize);
            bands.push(band);
            rest = after;
        }
        bands.into_par_iter().enumerate().with_max_len(1).for_each(|(row, mut moments)| {
            for column in 0..self.tiles_x {
                let tile = row * self.tiles_x + column;
                let pairs = &self.pairs[self.start[tile] as usize..self.start[tile + 1] as usize];
                let (out, after) = std::mem::take(&mut moments).split_at_mut(pairs.len());
                moments = after;
                let (out, unvisited) = out.split_at_mut(visited[tile].pairs as usize);
                unvisited.fill(Moments::default());
                let pairs = &pairs[..out.len()];
                let input = TileInput { ranked, pairs, x: column * TILE, y: row * TILE, width, height };
                work(row, &input, out);
            }
        });
    }
}
