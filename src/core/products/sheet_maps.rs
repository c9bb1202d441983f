//! Selects snapshots for the sheet in bounded memory.

/// Maximum number of maps on the sheet of snapshots: the first, the last and some between.
const SHEET_MAPS_MAX: usize = 6;

/// A bounded selection of snapshots for the sheet: the first, and every 2^n-th after it.
#[derive(Default)]
pub(super) struct SheetMaps {
    maps: Vec<(Vec<f64>, String)>,
    offered: usize,
    /// log2 of the number of maps offered per map kept.
    halvings: u32,
}

impl SheetMaps {
    /// Offers a map, which is kept if its number is a multiple of the current stride.
    pub(super) fn offer(&mut self, map: &[f64], caption: &str) {
        let is_kept = |offered: usize, halvings: u32| offered.is_multiple_of(1 << halvings);
        if is_kept(self.offered, self.halvings) && self.maps.len() == 2 * SHEET_MAPS_MAX {
            let mut is_odd = true;
            self.maps.retain(|_| {
                is_odd = !is_odd;
                !is_odd
            });
            self.halvings += 1;
        }
        if is_kept(self.offered, self.halvings) {
            self.maps.push((map.to_vec(), caption.to_owned()));
        }
        self.offered += 1;
    }

    /// The maps for the sheet, in equal steps from the first to `last`, which was offered last.
    pub(super) fn evenly_spaced<'a>(
        &'a self,
        last: (&'a [f64], &'a str),
    ) -> impl Iterator<Item = (&'a [f64], &'a str)> {
        let is_last = |k: usize| (k << self.halvings) + 1 == self.offered;
        let others = (0..self.maps.len()).filter(|&k| !is_last(k)).count();
        let places = SHEET_MAPS_MAX.min(others + 1);
        (0..places).map(move |place| {
            let k = if places > 1 { place * others / (places - 1) } else { 0 };
            let kept = self.maps[..others].get(k);
            kept.map_or(last, |(map, caption)| (map.as_slice(), caption.as_str()))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sheet_goes_from_the_first_map_to_the_last_in_bounded_memory() {
        for count in [1, 2, 5, 6, 7, 12, 13, 24, 25, 100, 471] {
            let mut shown = SheetMaps::default();
            for k in 0..count {
                shown.offer(&[k as f64], &k.to_string());
                assert!(shown.maps.len() <= 2 * SHEET_MAPS_MAX);
            }
            let last = count - 1;
            let sheet: Vec<(f64, String)> = shown
                .evenly_spaced((&[last as f64], &last.to_string()))
                .map(|(map, caption)| (map[0], caption.to_owned()))
                .collect();
            assert_eq!(sheet.len(), SHEET_MAPS_MAX.min(count));
            assert_eq!((sheet[0].0, sheet[sheet.len() - 1].0), (0.0, last as f64));
            for (map, caption) in &sheet {
                assert_eq!(&map.to_string(), caption);
            }
            // Steps are multiples of the stride of kept maps, which is a twelfth to a sixth of all, so within a factor of two of
            // equal steps.
            let equal = last as f64 / (sheet.len().max(2) - 1) as f64;
            let steps = sheet.windows(2).map(|two| two[1].0 - two[0].0);
            assert!(
                steps.clone().all(|step| step >= 0.4 * equal && step <= 2.0 * equal),
                "{count}: {sheet:?}"
            );
        }
    }
}
