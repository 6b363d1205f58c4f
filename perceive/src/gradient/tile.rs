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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gradient::vectorised::{AVX2, BASE};

    #[test]
    fn every_level_multiplies() {
        let depth = 5;
        let weights: Vec<[f32; ROWS]> = (0..depth).map(|k| std::array::from_fn(|r| (3 * k + r) as f32 - 7.0)).collect();
        let panel: Vec<[f32; COLUMNS]> = (0..depth).map(|k| std::array::from_fn(|c| (k * c % 11) as f32)).collect();
        // Whole numbers, so that every order of sums is exact.
        let sum = |r: usize, c: usize| (0..depth).map(|k| weights[k][r] * panel[k][c]).sum();
        let expected: Tile = std::array::from_fn(|r| std::array::from_fn(|c| sum(r, c)));
        let levels = [multiply_level::<BASE>, multiply_level::<AVX2>, multiply_level::<AVX512>, multiply];
        for level in levels {
            let mut tile = [[f32::NAN; COLUMNS]; ROWS];
            level(&weights, &panel, &mut tile);
            assert_eq!(tile, expected);
        }
    }
}
