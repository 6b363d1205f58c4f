//! Which of the things seen belongs to which of those that are known: the pairs with the least sum of costs.

use pathfinding::kuhn_munkres::kuhn_munkres_min;
use pathfinding::matrix::Matrix;

/// Costs are compared as integers of this fraction.
const FRACTION: f64 = 1e-4;

/// For each of `rows`, its partner among `columns`, if any. A pair may cost up to `limit`; a row alone costs that much. `cost` is called
/// for every pair, and what is over the limit or no number is no pair.
pub(crate) fn assigned(
    rows: usize,
    columns: usize,
    limit: f64,
    cost: impl Fn(usize, usize) -> f64,
) -> Vec<Option<usize>> {
    if rows == 0 {
        return Vec::new();
    }
    let whole = |cost: f64| (cost / FRACTION) as i64;
    let alone = whole(limit) + 1;
    // Each row has a column of its own, in which it stays alone.
    let costs = Matrix::from_fn(rows, columns + rows, |(row, column)| match column.checked_sub(columns) {
        Some(own) if own == row => alone,
        Some(_) => 4 * alone,
        None => Some(cost(row, column)).filter(|cost| (0.0..=limit).contains(cost)).map_or(4 * alone, whole),
    });
    let (_, partners) = kuhn_munkres_min(&costs);
    let is_pair = |(row, column): (usize, usize)| (column < columns && costs[(row, column)] < alone).then_some(column);
    partners.into_iter().enumerate().map(is_pair).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sum_of_costs_is_least_and_what_costs_too_much_stays_alone() {
        // Row 0 is nearest to column 0, but row 1 has no other.
        let costs = [[1.0, 2.0, 50.0], [1.5, 9.0, f64::NAN], [50.0, 50.0, -1.0]];
        assert_eq!(assigned(3, 3, 5.0, |row, column| costs[row][column]), [Some(1), Some(0), None]);
        assert_eq!(assigned(2, 0, 5.0, |_, _| 0.0), [None, None]);
        assert!(assigned(0, 3, 5.0, |_, _| 0.0).is_empty());
        assert_eq!(assigned(1, 2, 5.0, |_, column| [5.0, 5.1][column]), [Some(0)]);
    }
}
