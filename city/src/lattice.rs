//! Layout of the road network: spacing of lattice lines, their bends, quarters and blocks, and the extents of
//! crossings.

use glam::DVec2;
use rayon::prelude::*;

use crate::random::Random;
use crate::roads::{Block, Edge, Quarter, RoadKind, Roads, SAMPLE_METRES};
use crate::settings::{CitySettings, Layout};

/// Cities narrower than this are too narrow for three fine cells per main cell and, unless compact, for bends, metres.
const NARROW_METRES: f64 = 130.0;
/// Shortest span of lattice lines that a deck with its ramps fits on in a compact city, metres.
const MIN_DECK_SPAN: f64 = 128.0;

/// Lays out the road network of a city.
pub(crate) fn lay_roads(settings: &CitySettings, random: &Random) -> Roads {
    let mut lattice = Lattice::new(settings, random);
    let mut roads = lattice.assign_blocks();
    for index in 0..roads.edges.len() {
        let kind = roads.kind_of(index);
        roads.edges[index] = kind.map(|kind| Edge { profile: kind.profile(), path: Vec::new() });
    }
    lattice.draw_paths(&mut roads);
    roads
}

/// The lattice: straight lines, and the map that bends them.
struct Lattice {
    layout: Layout,
    is_compact: bool,
    xs: Vec<f64>,
    ys: Vec<f64>,
    fine: usize,
    bends: Vec<Bend>,
    random: Random,
    /// Main cells per region of one layout in a mixed city.
    region: [f64; 2],
}

/// A sinusoidal shift of one coordinate along the other. The map is injective while the product of the slopes is under
/// 1.
#[derive(Clone, Copy)]
struct Bend {
    layout: Layout,
    shift_y: bool,
    amplitude: f64,
    wave: f64,
    phase: f64,
}

impl Lattice {
    fn new(settings: &CitySettings, random: &Random) -> Self {
        let mut random = random.fork(0x40AD);
        let layout = settings.layout;
        let extent = settings.extent_metres();
        let half = 0.5 * extent;
        // a strip beside a wide plain has no space for bends and alleys
        let width = (1.0 - settings.plain) * extent;
        let is_narrow = width < NARROW_METRES;
        let is_compact = settings.is_compact();
        let bends = match (is_compact, is_narrow) {
            (true, _) => compact_bends(layout, width, &mut random),
            (false, true) => Vec::new(),
            (false, false) => bends(layout, extent, &mut random),
        };
        let reach = |shift_y: bool| bends.iter().filter(|b| b.shift_y == shift_y).map(|b| b.amplitude).sum::<f64>();
        let outer = if is_compact { RoadKind::Lane } else { RoadKind::Street };
        let border = outer.profile().front() + 0.5;
        let (reach_x, reach_y) = (reach(false) + border, reach(true) + border);
        let fine = match layout {
            Layout::Alley | Layout::Mixed if !is_narrow => 3,
            // a cell of 30 m fits one alley
            Layout::Alley if is_compact => 2,
            _ => 1,
        };
        let [wide, tall] = match layout {
            Layout::CurvedCorridor => [84.0, 72.0],
            Layout::Winding => [100.0, 84.0],
            Layout::Deck => [104.0, 96.0],
            Layout::Grid => [92.0, 84.0],
            Layout::Alley | Layout::Mixed => [100.0, 96.0],
        };
        let mut jitter = if layout == Layout::Deck { 0.04 } else { 0.1 };
        if extent < 400.0 {
            jitter *= 0.5;
        }
        let west = -half + settings.plain * extent;
        let decked = matches!(layout, Layout::Deck | Layout::Mixed);
        // the road on a main line, which alleys keep clear of
        let main_road = if is_compact && layout == Layout::Alley { RoadKind::Lane } else { RoadKind::Street };
        let no_deck = |_: usize, _: usize| main_road;
        let deck = |line: usize, main: usize| {
            if decked && line == main / 2 { RoadKind::Boulevard } else { main_road }
        };
        // a compact city keeps two rows (see `CitySettings::is_compact`), a mixed one two columns where they fit
        let min_rows = if is_compact { 2 } else { 1 };
        let min_columns = if is_compact && !is_narrow && layout == Layout::Mixed { 2 } else { 1 };
        let x_span = [west + reach_x, half - reach_x];
        let xs = Spacing { pitch: wide, min_cells: min_columns, fine, jitter }.lines(x_span, &mut random, &no_deck);
        let y_span = [-half + reach_y, half - reach_y];
        let ys = Spacing { pitch: tall, min_cells: min_rows, fine, jitter }.lines(y_span, &mut random, &deck);
        let region = [&xs, &ys].map(|l| (((l.len() - 1) / fine) as f64 / 3.0).clamp(1.0, 4.0).floor());
        Self { layout, is_compact, xs, ys, fine, bends, random, region }
    }

    /// The layout of a main cell.
    fn layout_of(&self, i: usize, j: usize) -> Layout {
        const TURNS: [Layout; 5] =
            [Layout::CurvedCorridor, Layout::Alley, Layout::Grid, Layout::Winding, Layout::CurvedCorridor];
        if self.layout != Layout::Mixed {
            return self.layout;
        }
        let (i, j) = ((i as f64 / self.region[0]) as usize, (j as f64 / self.region[1]) as usize);
        TURNS[(i + 2 * j) % 4]
    }

    /// Divides the lattice into quarters (one or several main cells) and blocks.
    fn assign_blocks(&mut self) -> Roads {
        let fine = self.fine;
        let cells = [self.xs.len() - 1, self.ys.len() - 1];
        let (columns, rows) = (cells[0] / fine, cells[1] / fine);
        let decked = matches!(self.layout, Layout::Deck | Layout::Mixed);
        let is_long = !self.is_compact || self.xs[cells[0]] - self.xs[0] >= MIN_DECK_SPAN;
        let deck = (decked && is_long && rows > 1).then_some((rows / 2) * fine);
        let mut roads = Roads {
            cells,
            fine,
            edges: Vec::new(),
            nodes: Vec::new(),
            quarters: Vec::new(),
            blocks: Vec::new(),
            deck,
            is_compact: self.is_compact,
        };
        roads.edges = vec![None; cells[0] * (cells[1] + 1) + (cells[0] + 1) * cells[1]];
        for row in 0..rows {
            let mut i = 0;
            while i < columns {
                let layout = self.layout_of(i, row);
                let max_cells = match layout {
                    Layout::CurvedCorridor => 2 + self.random.below(2),
                    Layout::Winding | Layout::Grid => 1 + usize::from(self.random.chance(0.25)),
                    _ => 1,
                };
                let joined =
                    (1..=max_cells).take_while(|k| i + k <= columns && self.layout_of(i + k - 1, row) == layout);
                let count = joined.last().unwrap_or(1);
                let lines = [i * fine, (i + count) * fine, row * fine, (row + 1) * fine];
                self.split(&mut roads, Quarter { lines, layout, row });
                i += count;
            }
        }
        roads
    }

    fn split(&mut self, roads: &mut Roads, quarter: Quarter) {
        let [west, east, south, north] = quarter.lines;
        let index = roads.quarters.len();
        roads.quarters.push(quarter);
        if quarter.layout == Layout::Alley {
            for j in south..north {
                let mut i = west;
                while i < east {
                    let next = (i + 1 + usize::from(self.random.chance(0.3))).min(east);
                    roads.blocks.push(Block { lines: [i, next, j, j + 1], quarter: index });
                    i = next;
                }
            }
        } else {
            roads.blocks.push(Block { lines: quarter.lines, quarter: index });
        }
    }

    /// World position of a lattice point.
    fn bend(&self, u: f64, v: f64) -> DVec2 {
        let mut p = DVec2::new(u, v);
        for bend in &self.bends {
            let weight = self.weight(bend.layout, u, v);
            let along = if bend.shift_y { u } else { v };
            let shift = weight * bend.amplitude * (bend.wave * along + bend.phase).sin();
            if bend.shift_y {
                p.y += shift;
            } else {
                p.x += shift;
            }
        }
        p
    }

    /// Weight of a layout at a lattice point, 0 to 1, blended over the width of a main cell.
    fn weight(&self, layout: Layout, u: f64, v: f64) -> f64 {
        if self.layout != Layout::Mixed {
            return 1.0;
        }
        let soft = |lines: &[f64], x: f64| {
            let cells = (lines.len() - 1) / self.fine;
            let (low, high) = (lines[0], lines[lines.len() - 1]);
            let t = ((x - low) / (high - low) * cells as f64 - 0.5).clamp(0.0, (cells - 1) as f64);
            let k = (t as usize).min(cells.saturating_sub(2));
            let f = t - k as f64;
            (k, f * f * (3.0 - 2.0 * f), cells)
        };
        let ((i, fu, columns), (j, fv, rows)) = (soft(&self.xs, u), soft(&self.ys, v));
        let is = |i: usize, j: usize| f64::from(self.layout_of(i.min(columns - 1), j.min(rows - 1)) == layout);
        let along = |j: usize| is(i, j) * (1.0 - fu) + is(i + 1, j) * fu;
        along(j) * (1.0 - fv) + along(j + 1) * fv
    }

    /// Samples the centre lines of all edges, shortened at crossings.
    fn draw_paths(&self, roads: &mut Roads) {
        let place = |i: usize, j: usize| self.bend(self.xs[i], self.ys[j]);
        let [nx, ny] = roads.cells;
        roads.nodes = (0..=ny).flat_map(|j| (0..=nx).map(move |i| (i, j))).map(|(i, j)| place(i, j)).collect();
        let lines: Vec<Vec<DVec2>> = (0..roads.edges.len()).map(|e| self.edge_line(roads, e)).collect();
        let cuts: Vec<[f64; 4]> = {
            let roads: &Roads = roads;
            (0..roads.nodes.len()).into_par_iter().map(|n| arm_cuts(roads, &lines, n)).collect()
        };
        // all edges of a column or row get the same number of samples, so that opposite sides of a block match
        let lengths: Vec<f64> = lines.iter().map(|l| l.windows(2).map(|w| w[0].distance(w[1])).sum()).collect();
        let longest =
            |edges: &mut dyn Iterator<Item = usize>| edges.fold(SAMPLE_METRES, |longest, e| lengths[e].max(longest));
        let count = |length: f64| (length / SAMPLE_METRES).ceil() as usize;
        for i in 0..nx {
            let samples = count(longest(&mut (0..=ny).map(|j| roads.horizontal(i, j))));
            for j in 0..=ny {
                let (edge, ends) = (roads.horizontal(i, j), [roads.node(i, j), roads.node(i + 1, j)]);
                let ends = [cuts[ends[0]][0], cuts[ends[1]][2]];
                set_path(&mut roads.edges[edge], &lines[edge], ends, samples);
            }
        }
        for j in 0..ny {
            let samples = count(longest(&mut (0..=nx).map(|i| roads.vertical(i, j))));
            for i in 0..=nx {
                let (edge, ends) = (roads.vertical(i, j), [roads.node(i, j), roads.node(i, j + 1)]);
                let ends = [cuts[ends[0]][1], cuts[ends[1]][3]];
                set_path(&mut roads.edges[edge], &lines[edge], ends, samples);
            }
        }
    }

    /// The densely sampled line of an edge from node to node.
    fn edge_line(&self, roads: &Roads, edge: usize) -> Vec<DVec2> {
        const FINE: usize = 48;
        let horizontals = self.horizontals(roads);
        let t = (0..=FINE).map(|k| k as f64 / FINE as f64);
        let between = |lines: &[f64], i: usize, t: f64| lines[i] + (lines[i + 1] - lines[i]) * t;
        if edge < horizontals {
            let (i, j) = (edge % roads.cells[0], edge / roads.cells[0]);
            t.map(|t| self.bend(between(&self.xs, i, t), self.ys[j])).collect()
        } else {
            let edge = edge - horizontals;
            let (i, j) = (edge % (roads.cells[0] + 1), edge / (roads.cells[0] + 1));
            t.map(|t| self.bend(self.xs[i], between(&self.ys, j, t))).collect()
        }
    }

    fn horizontals(&self, roads: &Roads) -> usize {
        roads.cells[0] * (roads.cells[1] + 1)
    }
}

impl Bend {
    /// A bend of this wavelength (metres) and steepest slope, at a random phase.
    fn new(layout: Layout, shift_y: bool, length: f64, slope: f64, random: &mut Random) -> Self {
        let wave = std::f64::consts::TAU / length;
        let phase = f64::from(random.range(0.0, std::f32::consts::TAU));
        Self { layout, shift_y, amplitude: slope / wave, wave, phase }
    }
}

/// The bends of a compact city: shorter waves than those of [`bends`], so that a street of 60 m shows one, and with
/// less amplitude, because the bends take their reach from the blocks.
fn compact_bends(layout: Layout, width: f64, random: &mut Random) -> Vec<Bend> {
    let mut bend =
        |layout: Layout, shift_y: bool, length: f64, slope: f64| Bend::new(layout, shift_y, length, slope, random);
    use Layout::{Alley, CurvedCorridor, Winding};
    match layout {
        Layout::Grid | Layout::Deck => Vec::new(),
        Alley => vec![bend(Alley, true, 87.0, 0.12), bend(Alley, false, 71.0, 0.1)],
        CurvedCorridor => vec![bend(CurvedCorridor, true, (0.9 * width).clamp(80.0, 200.0), 0.4)],
        Winding => vec![
            bend(Winding, true, (1.1 * width).clamp(90.0, 170.0), 0.22),
            bend(Winding, false, (0.9 * width).clamp(75.0, 150.0), 0.16),
        ],
        // two rows of one cell each, without winding streets and alleys
        Layout::Mixed if width < NARROW_METRES => vec![bend(CurvedCorridor, true, 90.0, 0.3)],
        Layout::Mixed => vec![
            bend(CurvedCorridor, true, 110.0, 0.25),
            bend(Winding, true, 110.0, 0.2),
            bend(Winding, false, 100.0, 0.2),
            bend(Alley, true, 87.0, 0.1),
            bend(Alley, false, 71.0, 0.1),
        ],
    }
}

/// Bends whose slopes stay under 0.75 (one direction only) or 0.45 (both).
fn bends(layout: Layout, extent: f64, random: &mut Random) -> Vec<Bend> {
    let mut bend =
        |layout: Layout, shift_y: bool, length: f64, slope: f64| Bend::new(layout, shift_y, length, slope, random);
    use Layout::{CurvedCorridor, Winding};
    match layout {
        Layout::Grid | Layout::Deck => Vec::new(),
        Layout::Alley => vec![
            bend(Layout::Alley, true, 87.0, 0.16),
            bend(Layout::Alley, false, 71.0, 0.16),
            bend(Layout::Alley, true, 310.0, 0.08),
        ],
        CurvedCorridor => {
            let length = (0.9 * extent).clamp(200.0, 380.0);
            vec![bend(CurvedCorridor, true, length, 0.6), bend(CurvedCorridor, false, 600.0, 0.08)]
        }
        Winding => vec![
            bend(Winding, true, (0.8 * extent).clamp(170.0, 260.0), 0.24),
            bend(Winding, false, (0.8 * extent).clamp(170.0, 230.0), 0.24),
            bend(Winding, true, 118.0, 0.13),
            bend(Winding, false, 103.0, 0.13),
        ],
        Layout::Mixed => vec![
            bend(CurvedCorridor, true, 230.0, 0.42),
            bend(Winding, true, 200.0, 0.25),
            bend(Winding, false, 180.0, 0.25),
            bend(Winding, true, 110.0, 0.12),
            bend(Winding, false, 97.0, 0.12),
            bend(Layout::Alley, true, 87.0, 0.15),
            bend(Layout::Alley, false, 71.0, 0.15),
        ],
    }
}

/// How lattice lines are spaced along one axis.
struct Spacing {
    /// Width of a main cell, about, metres.
    pitch: f64,
    min_cells: usize,
    /// Fine cells to a main cell.
    fine: usize,
    /// Share by which the width of a main cell varies.
    jitter: f64,
}

impl Spacing {
    /// Lattice lines from one end to the other. Fine lines divide the width that the fronts of the main roads leave;
    /// `main_road(line, cells)` is the kind of road on a main line.
    fn lines(
        &self,
        [from, to]: [f64; 2],
        random: &mut Random,
        main_road: &dyn Fn(usize, usize) -> RoadKind,
    ) -> Vec<f64> {
        let Self { pitch, min_cells, fine, jitter } = *self;
        let main = (((to - from) / pitch).round() as usize).max(min_cells);
        let shares: Vec<f64> = (0..main).map(|_| 1.0 + jitter * f64::from(random.range(-1.0, 1.0))).collect();
        let scale = (to - from) / shares.iter().sum::<f64>();
        let inset = |line: usize| main_road(line, main).profile().front() - RoadKind::Alley.profile().front();
        let mut lines = vec![from];
        let mut at = from;
        for (k, share) in shares.into_iter().enumerate() {
            let (low, high) = (at + inset(k), at + share * scale - inset(k + 1));
            for part in 1..fine {
                let uneven = 0.15 * f64::from(random.range(-1.0, 1.0));
                lines.push(low + (high - low) * (part as f64 + uneven) / fine as f64);
            }
            at += share * scale;
            lines.push(at);
        }
        lines
    }
}

/// One arm of a crossing: a road seen from its end.
struct Arm {
    arm: usize,
    /// Centre line from the node outwards, and the arc length at each point.
    points: Vec<DVec2>,
    along: Vec<f64>,
    front: f64,
}

impl Arm {
    fn new(roads: &Roads, lines: &[Vec<DVec2>], node: usize, arm: usize) -> Option<Self> {
        let (index, away) = roads.arm(node, arm)?;
        let mut points = lines[index].clone();
        if !away {
            points.reverse();
        }
        let mut along = vec![0.0];
        for pair in points.windows(2) {
            along.push(along[along.len() - 1] + pair[0].distance(pair[1]));
        }
        Some(Self { arm, points, along, front: roads.edges[index].as_ref()?.profile.front() })
    }

    /// Arc length up to which this arm's front line on the left (1) or right (-1) lies between another arm's front
    /// lines.
    fn within(&self, side: f64, other: &Self) -> f64 {
        let last = self.points.len() - 1;
        let inside = |k: usize| {
            let along = (self.points[(k + 1).min(last)] - self.points[k.saturating_sub(1)]).normalize_or_zero();
            let p = self.points[k] + side * self.front * along.perp();
            other.points.windows(2).any(|w| {
                let (a, b) = (w[0], w[1]);
                let t = ((p - a).dot(b - a) / (b - a).length_squared()).clamp(0.0, 1.0);
                p.distance(a.lerp(b, t)) < other.front - 0.05
            })
        };
        // a crossing takes less than 60 % of an arm
        let reach = self.along.partition_point(|&s| s < 0.6 * self.along[last]);
        let out = (0..reach).rev().find(|&k| inside(k)).map_or(0, |k| k + 1);
        self.along[out]
    }
}

/// Distance from a node at which each arm starts: where its front lines no longer overlap those of its neighbours.
fn arm_cuts(roads: &Roads, lines: &[Vec<DVec2>], node: usize) -> [f64; 4] {
    let mut cuts = [0.0f64; 4];
    let arms: Vec<Arm> = (0..4).filter_map(|arm| Arm::new(roads, lines, node, arm)).collect();
    for k in 0..arms.len() {
        let (one, next) = (&arms[k], &arms[(k + 1) % arms.len()]);
        for (arm, side, other) in [(one, 1.0, next), (next, -1.0, one)] {
            cuts[arm.arm] = cuts[arm.arm].max(arm.within(side, other) + 1.5);
        }
    }
    cuts
}

/// Samples an edge evenly between the crossings at its ends.
fn set_path(edge: &mut Option<Edge>, line: &[DVec2], cuts: [f64; 2], samples: usize) {
    let Some(edge) = edge else { return };
    let mut along = vec![0.0];
    for pair in line.windows(2) {
        along.push(along[along.len() - 1] + pair[0].distance(pair[1]));
    }
    let length = along[along.len() - 1];
    let at = |s: f64| {
        let k = along.partition_point(|&a| a <= s).clamp(1, line.len() - 1);
        line[k - 1].lerp(line[k], (s - along[k - 1]) / (along[k] - along[k - 1]))
    };
    // a short road keeps at least 15 % of its length
    let scale = (0.85 * length / (cuts[0] + cuts[1])).min(1.0);
    let (from, to) = (scale * cuts[0], length - scale * cuts[1]);
    edge.path = (0..=samples)
        .map(|k| {
            let s = from + (to - from) * k as f64 / samples as f64;
            (at(s), (at(s + 1.0) - at(s - 1.0)).normalize_or_zero())
        })
        .collect();
}
