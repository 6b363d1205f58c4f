//! The CPU backend: SIMD chosen at run time, rayon over chunks of splats and bands of tiles.
//!
//! Data flow of a view, one array a stage:
//! ```text
//! splats ─project→ records ─sort→ order ─bin→ pairs per tile ─rasterize→ frame
//! upstream ─rasterize_backward→ moments per pair ─reduce→ moments per splat ─project_backward→ gradients
//! ```
//! Every reduction runs in the order of the data, not of the threads, so results do not depend on their number. Threads take one chunk or band at
//! a time (`with_max_len(1)`): left to itself, rayon hands out quarters of a picture, and whoever has the lighter one waits.

mod bin;
pub mod ceiling;
mod contribute;
mod deal;
mod moments;
mod project;
mod project_backward;
mod rasterize;
mod sh;
pub mod simd;

use rayon::prelude::*;
use scene::{Camera, Splats};

use crate::{Contributions, Frame, Gradients, Options, Stages, Upstream};
use bin::{Bins, SortScratch, TILE};
use project::{Projected, View};
use project_backward::Sink;
use rasterize::{AHEAD, BackwardBand, Band, Moments, TileInput, Visited};
pub use simd::Isa;
use simd::prefetch;

/// Splats per parallel chunk; a multiple of the lanes.
const CHUNK: usize = 1024;

/// What a pass is made of, see the [module](self).
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
    /// In their order.
    pub const ALL: [Self; 7] = [
        Self::Project,
        Self::Sort,
        Self::Bin,
        Self::Rasterize,
        Self::RasterizeBackward,
        Self::Reduce,
        Self::ProjectBackward,
    ];

    /// Its name in every backend.
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

/// A renderer with its buffers, which it keeps from view to view.
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
    /// Rank of each splat in depth order; only those of seen splats mean anything.
    rank: Vec<u32>,
    sums: Vec<Moments>,
    gradients: Gradients,
    contributions: Contributions,
    frame: Frame,
    /// What the last `forward` drew, for `backward`.
    drawn: Option<(View, Options, usize)>,
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
            drawn: None,
        }
    }

    /// "cpu-avx512", "cpu-avx2" or "cpu-portable".
    pub fn name(&self) -> String {
        format!("cpu-{}", self.isa.name())
    }

    /// Draws the trainable splats and, with them, a frozen context.
    pub fn forward(&mut self, splats: &Splats, context: Option<&Splats>, camera: &Camera, options: &Options) -> &Frame {
        self.forward_watched(splats, context, camera, options, &mut |_| ())
    }

    /// As [`forward`](Self::forward); `done` is called after each stage, for whoever has a clock.
    pub fn forward_watched(
        &mut self,
        splats: &Splats,
        context: Option<&Splats>,
        camera: &Camera,
        options: &Options,
        done: &mut dyn FnMut(Stage),
    ) -> &Frame {
        let options = Options { sh_degree: options.sh_degree.min(splats.sh_degree()), ..*options };
        let view = View::new(camera);
        self.drawn = Some((view, options, splats.len()));
        self.project(splats, context, &view, &options);
        done(Stage::Project);
        bin::sort_by_depth(&self.records, &self.seen, &mut self.order, &mut self.sort);
        self.ranked.resize(self.order.len(), Projected::default());
        self.ranked.par_chunks_mut(CHUNK).zip(self.order.par_chunks(CHUNK)).for_each(|(ranked, order)| {
            ranked.iter_mut().zip(order).for_each(|(ranked, &i)| *ranked = self.records[i as usize]);
        });
        done(Stage::Sort);
        let (width, height) = (camera.pinhole.width as usize, camera.pinhole.height as usize);
        bin::bin(self.isa, &self.ranked, width, height, &mut self.bins);
        done(Stage::Bin);
        self.rasterize(width, height, &options);
        done(Stage::Rasterize);
        &self.frame
    }

    /// The last frame drawn.
    pub fn frame(&self) -> &Frame {
        &self.frame
    }

    /// Gradients of the trainable splats of the last [`forward`](Self::forward), whose splats must be passed again
    /// unchanged.
    ///
    /// # Panics
    /// Without a forward pass before, or with another number of splats: both are errors of the caller.
    pub fn backward(&mut self, splats: &Splats, upstream: &Upstream) -> &mut Gradients {
        self.backward_watched(splats, upstream, &mut |_| ())
    }

    /// As [`backward`](Self::backward); `done` is called after each stage, for whoever has a clock.
    ///
    /// # Panics
    /// As `backward`.
    pub fn backward_watched(
        &mut self,
        splats: &Splats,
        upstream: &Upstream,
        done: &mut dyn FnMut(Stage),
    ) -> &mut Gradients {
        let (view, options, count) = self.drawn.expect("backward follows forward");
        assert_eq!(count, splats.len(), "backward needs the splats that forward drew");
        self.rasterize_backward(upstream);
        done(Stage::RasterizeBackward);
        self.reduce(count);
        done(Stage::Reduce);
        self.project_backward(splats, &view, &options);
        done(Stage::ProjectBackward);
        &mut self.gradients
    }

    /// The last gradients.
    pub fn gradients(&self) -> &Gradients {
        &self.gradients
    }

    /// Pairs of splat and tile in the last view: what the rasterizer's time is proportional to.
    pub fn pairs(&self) -> usize {
        self.bins.pairs.len()
    }

    /// What the stages before `rasterize` came to in the last view.
    pub fn stages(&self) -> Stages {
        let own = self.drawn.map_or(0, |(.., own)| own as u32);
        let first_context = own.next_multiple_of(simd::LANES as u32);
        let record = |Projected(r): &Projected| {
            use project::at::{A, B, BLUE, C, GREEN, HALF_HEIGHT, HALF_WIDTH, LOG2_OPACITY, RED, X, Y, Z};
            [X, Y, A, B, C, LOG2_OPACITY, RED, GREEN, BLUE, Z, HALF_WIDTH, HALF_HEIGHT].map(|k| r[k])
        };
        Stages {
            order: self.order.iter().map(|&i| if i < own { i } else { i - first_context + own }).collect(),
            records: self.ranked.iter().map(record).collect(),
            start: self.bins.start.clone(),
            pairs: self.bins.pairs.iter().map(|pair| pair.rank).collect(),
        }
    }

    /// Blocks of 4×4 pixels that the rasterizer visited in the last view, each for one splat: what its arithmetic is
    /// proportional to. The backward pass visits the same.
    pub fn visits(&self) -> u64 {
        self.visited.iter().map(|tile| u64::from(tile.blocks)).sum()
    }

    fn project(&mut self, splats: &Splats, context: Option<&Splats>, view: &View, options: &Options) {
        // Context records start at a whole group of lanes.
        let first_context = splats.len().next_multiple_of(simd::LANES);
        let total = first_context + context.map_or(0, Splats::len);
        self.records.resize(total, Projected::default());
        self.seen.clear();
        self.seen.resize(total.div_ceil(simd::LANES), 0);
        let (own_records, context_records) = self.records.split_at_mut(first_context.min(total));
        let (own_seen, context_seen) = self.seen.split_at_mut(first_context / simd::LANES);
        let isa = self.isa;
        let draw = |splats: &Splats, options: &Options, own: f32, records: &mut [Projected], seen: &mut [u16]| {
            records
                .par_chunks_mut(CHUNK)
                .zip(seen.par_chunks_mut(CHUNK / simd::LANES))
                .enumerate()
                .with_max_len(1)
                .for_each(|(chunk, (records, seen))| {
                    project::project(isa, splats, chunk * CHUNK, view, options, own, records, seen);
                });
        };
        draw(splats, options, 1.0, &mut own_records[..splats.len()], own_seen);
        if let Some(context) = context {
            // The context is finished: it is drawn in full, whatever degree the trainable splats have reached.
            let options = Options { sh_degree: context.sh_degree(), ..*options };
            draw(context, &options, 0.0, context_records, context_seen);
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
        frame.own.resize(extra, 0.0);

        let rows = TILE * width;
        let mut colour = frame.colour.chunks_mut(area.max(1)).map(|plane| plane.chunks_mut(rows));
        let mut next_colour = || colour.next().expect("three colour planes");
        let (red, green, blue) = (next_colour(), next_colour(), next_colour());
        let mut depth = frame.depth.chunks_mut(rows);
        let mut own = frame.own.chunks_mut(rows);
        self.visited.resize(self.bins.tiles_x * self.bins.tiles_y, Visited::default());
        let bands: Vec<_> = (red.zip(green).zip(blue).zip(frame.transmittance.chunks_mut(rows)))
            .map(|(((red, green), blue), transmittance)| Band {
                colour: [red, green, blue],
                transmittance,
                depth: depth.next().unwrap_or_default(),
                own: own.next().unwrap_or_default(),
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
                rasterize::rasterize_backward(isa, tile, &BackwardBand::new(frame, upstream, row), out);
            },
        );
    }

    /// Adds up the pairs of each splat, in the order of its tiles. Splats are taken by depth, as pairs are numbered: only the pairs' own
    /// places then lie anywhere, and those are known ahead.
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
                    let ahead = bins.place.get(pair + AHEAD).and_then(|&place| moments.get(place as usize));
                    ahead.into_iter().for_each(prefetch);
                    for (total, value) in total.iter_mut().zip(&moments[bins.place[pair] as usize].0) {
                        *total += value;
                    }
                }
                *sum = Moments(total);
            }
        });
    }

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
        for column in out.columns.iter_mut().chain([&mut out.screen, &mut out.screen_abs, &mut out.weight]) {
            column.resize(n, 0.0);
        }
        let words = n.div_ceil(simd::LANES);
        out.seen.clear();
        out.seen.extend_from_slice(&self.seen[..words]);
        // Coefficients above the degree in use are not touched: their columns stay out of the sinks.
        let used = scene::column::SH + 3 * scene::splats::sh_coefficients(options.sh_degree);
        let mut sinks: Vec<Sink> = (out
            .screen
            .chunks_mut(CHUNK)
            .zip(out.screen_abs.chunks_mut(CHUNK))
            .zip(out.weight.chunks_mut(CHUNK)))
        .map(|((screen, screen_abs), weight)| Sink { columns: Vec::with_capacity(used), screen, screen_abs, weight })
        .collect();
        for column in &mut out.columns[..used] {
            for (sink, chunk) in sinks.iter_mut().zip(column.chunks_mut(CHUNK)) {
                sink.columns.push(chunk);
            }
        }
        let (isa, seen, sums, rank) = (self.isa, &self.seen, &self.sums, &self.rank);
        let poses: Vec<[f32; 6]> = (sinks.par_iter_mut().enumerate().with_max_len(1))
            .map(|(chunk, sink)| {
                let first = chunk * CHUNK;
                let rank = &rank[first..(first + CHUNK).min(n)];
                let seen = &seen[first / simd::LANES..];
                project_backward::project_backward(isa, splats, first, view, options, seen, rank, sums, sink)
            })
            .collect();
        out.pose = [0.0; 6];
        for pose in poses {
            for (total, part) in out.pose.iter_mut().zip(pose) {
                *total += part;
            }
        }
    }
}

impl Bins {
    /// Calls `work(row of tiles, tile, entries)` for every tile, in parallel over rows; entries that lie after the last pair
    /// a tile visited are cleared.
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
        // The pairs of a band of tiles lie together, so bands write disjoint slices.
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
                let (out, unseen) = out.split_at_mut(visited[tile].pairs as usize);
                unseen.fill(Moments::default());
                let pairs = &pairs[..out.len()];
                let input = TileInput { ranked, pairs, x: column * TILE, y: row * TILE, width, height };
                work(row, &input, out);
            }
        });
    }
}
