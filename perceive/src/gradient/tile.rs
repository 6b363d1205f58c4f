//! The innermost product: eight rows of weights times 32 columns.

use super::vectorised::{AVX512, add_scaled, vectorised};

/// Rows of a block of weights.
pub(super) const ROWS: usize = 8;
/// Columns of a panel.
pub(super) const COLUMNS: usize = 32;
/// A block of results.
pub(super) type Tile = [[f32; COLUMNS]; ROWS];

vectorised!(
    /// `tile[r][c] = Σ_k weights[k][r] · panel[k][c]`, summed by rising k.
    pub(super) fn multiply(weights: &[[f32; ROWS]], panel: &[[f32; COLUMNS]], tile: &mut Tile) = multiply_level
);

/// As much of a tile at once as the registers hold.
#[inline(always)]
fn multiply_level<const LEVEL: usize>(weights: &[[f32; ROWS]], panel: &[[f32; COLUMNS]], tile: &mut Tile) {
    if LEVEL == AVX512 {
        return all_rows::<LEVEL>(weights, panel, tile);
    }
    for row in [0, 4] {
        for column in [0, 16] {
            part::<LEVEL>(weights, panel, row, column, tile);
        }
    }
}

// The sums are variables of their own: the compiler keeps an array of them in memory.

#[inline(always)]
fn all_rows<const LEVEL: usize>(weights: &[[f32; ROWS]], panel: &[[f32; COLUMNS]], tile: &mut Tile) {
    let [mut a, mut b, mut c, mut d, mut e, mut f, mut g, mut h] = [[0.0; COLUMNS]; ROWS];
    for (w, x) in weights.iter().zip(panel) {
        a = add_scaled::<_, LEVEL>(w[0], x, a);
        b = add_scaled::<_, LEVEL>(w[1], x, b);
        c = add_scaled::<_, LEVEL>(w[2], x, c);
        d = add_scaled::<_, LEVEL>(w[3], x, d);
        e = add_scaled::<_, LEVEL>(w[4], x, e);
        f = add_scaled::<_, LEVEL>(w[5], x, f);
        g = add_scaled::<_, LEVEL>(w[6], x, g);
        h = add_scaled::<_, LEVEL>(w[7], x, h);
    }
    *tile = [a, b, c, d, e, f, g, h];
}

/// Four rows of sixteen columns.
#[inline(always)]
fn part<const LEVEL: usize>(
    weights: &[[f32; ROWS]],
    panel: &[[f32; COLUMNS]],
    row: usize,
    column: usize,
    tile: &mut Tile,
) {
    let [mut a, mut b, mut c, mut d] = [[0.0; 16]; 4];
    for (w, x) in weights.iter().zip(panel) {
        let Some(x) = x[column..].first_chunk::<16>() else { return };
        a = add_scaled::<_, LEVEL>(w[row], x, a);
        b = add_scaled::<_, LEVEL>(w[row + 1], x, b);
        c = add_scaled::<_, LEVEL>(w[row + 2], x, c);
        d = add_scaled::<_, LEVEL>(w[row + 3], x, d);
    }
    for (out, sums) in tile[row..row + 4].iter_mut().zip([a, b, c, d]) {
        out[column..column + 16].copy_from_slice(&sums);
    }
}
