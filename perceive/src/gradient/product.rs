//! Dense convolutions as products of matrices: weights of rows × (channels · taps) times the pixels that the taps read,
//! gathered panel by panel. The gradient of a convolution is one as well, of the same kind.

use std::ops::Range;

use rayon::prelude::*;

use super::axis::{Phase, Tap};
use super::tile::{COLUMNS, ROWS, Tile, multiply};

/// A convolution of planes.
pub(super) struct Product {
    /// Planes that are read, and the sides of each.
    channels: usize,
    source: [usize; 2],
    /// Planes that are written, and the sides of each.
    rows: usize,
    target: [usize; 2],
    /// Pixels of the target from one position of a part to the next.
    step: [usize; 2],
    parts: Vec<Part>,
}

/// The convolution for every `step`-th pixel of the target.
struct Part {
    start: [usize; 2],
    /// Positions along both axes.
    size: [usize; 2],
    taps: [Vec<Tap>; 2],
    /// Whether position `i` reads pixel `i` and no other.
    is_pointwise: bool,
    /// Blocks of eight rows: for every channel, tap along y and tap along x the weights of the rows.
    blocks: Vec<Vec<[f32; ROWS]>>,
}

impl Product {
    /// A convolution of `channels` planes of sides `source` (height, width) to `rows` planes of sides `target`. `axes`
    /// says what is read, along y and x; `weight` is asked for row, channel, and tap along y and x.
    pub(super) fn new(
        [rows, channels]: [usize; 2],
        [source, target]: [[usize; 2]; 2],
        [along_y, along_x]: [Vec<Phase>; 2],
        weight: impl Fn(usize, usize, usize, usize) -> f32,
    ) -> Self {
        let step = [along_y.len(), along_x.len()];
        let part = |y: &Phase, x: &Phase| {
            let weights = |row: usize| {
                let weight = &weight;
                let taps = y.taps.iter().flat_map(move |y| x.taps.iter().map(move |x| (y.number, x.number)));
                (0..channels).flat_map(move |channel| {
                    taps.clone().map(move |(y, x)| if row < rows { weight(row, channel, y, x) } else { 0.0 })
                })
            };
            let block = |block: usize| {
                let mut columns = vec![[0.0; ROWS]; channels * y.taps.len() * x.taps.len()];
                for r in 0..ROWS {
                    columns.iter_mut().zip(weights(ROWS * block + r)).for_each(|(column, weight)| column[r] = weight);
                }
                columns
            };
            let is_identity = |phase: &Phase, side: usize| {
                let all = Tap { number: 0, from: 0, to: side, first: 0, step: 1 };
                phase.positions == side && phase.taps == [all]
            };
            Part {
                start: [y.start, x.start],
                size: [y.positions, x.positions],
                taps: [y.taps.clone(), x.taps.clone()],
                is_pointwise: step == [1, 1] && is_identity(y, source[0]) && is_identity(x, source[1]),
                blocks: (0..rows.div_ceil(ROWS)).map(block).collect(),
            }
        };
        let parts = along_y.iter().flat_map(|y| along_x.iter().map(move |x| part(y, x))).collect();
        Self { channels, source, rows, target, step, parts }
    }

    /// With a `bias` of each row, writes the convolution of `source` plus the bias; without, adds the convolution to
    /// what is there.
    pub(super) fn run(&self, source: &[f32], bias: Option<&[f32]>, target: &mut [f32]) {
        let plane = self.target[0] * self.target[1];
        // Bands begin where a row of every part does, or anywhere if there is one part.
        let unit = if self.step == [1, 1] { COLUMNS } else { self.step[0] * self.target[1] };
        let band = (plane / 16).clamp(64, 1024).next_multiple_of(unit);
        let mut jobs: Vec<Vec<&mut [f32]>> = (0..plane.div_ceil(band)).map(|_| Vec::with_capacity(self.rows)).collect();
        for row in target.chunks_mut(plane) {
            jobs.iter_mut().zip(row.chunks_mut(band)).for_each(|(job, segment)| job.push(segment));
        }
        let depth = self.parts.iter().map(|part| self.channels * part.taps[0].len() * part.taps[1].len()).max();
        let room = || vec![[0.0; COLUMNS]; depth.unwrap_or(0)];
        jobs.into_par_iter().enumerate().with_max_len(1).for_each_init(room, |panel, (number, mut rows)| {
            for part in &self.parts {
                self.run_part(part, source, bias, number * band, &mut rows, panel);
            }
        });
    }

    /// One part of a band that begins at pixel `begin` of each target plane; `rows` are its pixels.
    fn run_part(
        &self,
        part: &Part,
        source: &[f32],
        bias: Option<&[f32]>,
        begin: usize,
        rows: &mut [&mut [f32]],
        panel: &mut [[f32; COLUMNS]],
    ) {
        let [height, width] = part.size;
        let length = rows.first().map_or(0, |row| row.len());
        // Positions of the part, counted by rows, that lie in the band.
        let positions = if self.step == [1, 1] {
            begin..begin + length
        } else {
            let row_at = |pixel: usize| (pixel / self.target[1]).saturating_sub(part.start[0]).div_ceil(self.step[0]);
            width * row_at(begin).min(height)..width * row_at(begin + length).min(height)
        };
        let panel = &mut panel[..self.channels * part.taps[0].len() * part.taps[1].len()];
        let mut tile: Tile = [[0.0; COLUMNS]; ROWS];
        for first in positions.clone().step_by(COLUMNS) {
            let positions = first..positions.end.min(first + COLUMNS);
            self.gather(part, source, positions.clone(), panel);
            for (number, (block, rows)) in part.blocks.iter().zip(rows.chunks_mut(ROWS)).enumerate() {
                multiply(block, panel, &mut tile);
                for (r, (row, sums)) in rows.iter_mut().zip(&tile).enumerate() {
                    let sums = &sums[..positions.len()];
                    let bias = bias.map(|bias| bias[ROWS * number + r]);
                    if self.step == [1, 1] {
                        let pixels = row[positions.start - begin..].iter_mut();
                        match bias {
                            Some(bias) => pixels.zip(sums).for_each(|(pixel, sum)| *pixel = sum + bias),
                            None => pixels.zip(sums).for_each(|(pixel, sum)| *pixel += sum),
                        }
                    } else {
                        for (position, sum) in positions.clone().zip(sums) {
                            let pixel = &mut row[self.pixel(part, position) - begin];
                            *pixel = sum + bias.unwrap_or(*pixel);
                        }
                    }
                }
            }
        }
    }

    /// The pixel of the target that a position of a part is.
    fn pixel(&self, part: &Part, position: usize) -> usize {
        let [y, x] = [position / part.size[1], position % part.size[1]];
        (part.start[0] + self.step[0] * y) * self.target[1] + part.start[1] + self.step[1] * x
    }

    /// Writes what the taps read at up to 32 positions: a row for every channel, tap along y and tap along x.
    fn gather(&self, part: &Part, source: &[f32], positions: Range<usize>, panel: &mut [[f32; COLUMNS]]) {
        let plane = self.source[0] * self.source[1];
        let planes = source.chunks_exact(plane);
        if part.is_pointwise {
            for (row, plane) in panel.iter_mut().zip(planes) {
                row[..positions.len()].copy_from_slice(&plane[positions.clone()]);
            }
            return;
        }
        let mut rows = panel.iter_mut();
        for plane in planes {
            for (y, x) in part.taps[0].iter().flat_map(|y| part.taps[1].iter().map(move |x| (y, x))) {
                let Some(row) = rows.next() else { return };
                let mut at = positions.start;
                while at < positions.end {
                    // The positions up to the end of a line of the part.
                    let [line, from] = [at / part.size[1], at % part.size[1]];
                    let count = (part.size[1] - from).min(positions.end - at);
                    let out = &mut row[at - positions.start..][..count];
                    match y.reads(line) {
                        Some(y) => read_line(&plane[y * self.source[1]..][..self.source[1]], x, from, out),
                        None => out.fill(0.0),
                    }
                    at += count;
                }
            }
        }
    }
}

/// What a tap reads of a line at positions `from..`.
fn read_line(line: &[f32], tap: &Tap, from: usize, out: &mut [f32]) {
    let start = tap.from.clamp(from, from + out.len());
    let end = tap.to.clamp(start, from + out.len());
    out[..start - from].fill(0.0);
    out[end - from..].fill(0.0);
    let Some(first) = tap.reads(start).filter(|_| start < end) else { return };
    let out = &mut out[start - from..end - from];
    if tap.step == 1 {
        out.copy_from_slice(&line[first..first + out.len()]);
    } else {
        out.iter_mut().zip(line[first..].iter().step_by(tap.step)).for_each(|(out, value)| *out = *value);
    }
}
