//! Accounting of samples (in space of voltages, on the ground of visibilities), which must balance at the end of a run: sampled = accumulated + flagged + lost.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use serde::Serialize;
use serde::ser::{SerializeStruct, Serializer};
use thiserror::Error;

use crate::units::Reason;

/// Counts samples that were taken, and how many of them were accumulated, flagged or lost. Clones share one set of counts.
///
/// Counts saturate at `u64::MAX`. Adding takes a lock, so add by block, not by sample.
#[derive(Clone, Debug)]
pub struct Ledger<R: Reason>(Arc<Mutex<LedgerReport<R>>>);

impl<R: Reason> Default for Ledger<R> {
    fn default() -> Self {
        Self::new()
    }
}

impl<R: Reason> Ledger<R> {
    /// A ledger without entries.
    #[must_use]
    pub fn new() -> Self {
        Self(Arc::default())
    }

    fn counts(&self) -> MutexGuard<'_, LedgerReport<R>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds `count` samples that were taken.
    pub fn add_sampled(&self, count: u64) {
        add(&mut self.counts().sampled, count);
    }

    /// Adds `count` samples that reached the result.
    pub fn add_accumulated(&self, count: u64) {
        add(&mut self.counts().accumulated, count);
    }

    /// Adds `count` samples that were flagged or lost for `reason`.
    pub fn add_left_out(&self, reason: R, count: u64) {
        self.counts().leave_out(reason, count);
    }

    /// Counts samples that had reached the result, and were removed from it, as flagged.
    #[doc(hidden)]
    pub fn move_to_left_out(&self, reason: R, count: u64) {
        let mut counts = self.counts();
        counts.accumulated = counts.accumulated.saturating_sub(count);
        counts.leave_out(reason, count);
    }

    /// Adds all counts of a report.
    #[doc(hidden)]
    pub fn post_report(&self, report: &LedgerReport<R>) {
        let mut counts = self.counts();
        add(&mut counts.sampled, report.sampled);
        add(&mut counts.accumulated, report.accumulated);
        for (&reason, &count) in &report.left_out {
            counts.leave_out(reason, count);
        }
    }

    /// Returns all counts and resets them to zero.
    #[must_use]
    #[doc(hidden)]
    pub fn take(&self) -> LedgerReport<R> {
        std::mem::take(&mut *self.counts())
    }

    /// All counts, whether or not they balance.
    #[must_use]
    pub fn report(&self) -> LedgerReport<R> {
        self.counts().clone()
    }

    /// All counts, after checking that they balance.
    ///
    /// # Errors
    /// [`LedgerImbalance`] unless sampled = accumulated + flagged + lost.
    #[doc(hidden)]
    pub fn balanced_report(&self) -> Result<LedgerReport<R>, LedgerImbalance<R>> {
        let report = self.report();
        if report.unaccounted() == 0 { Ok(report) } else { Err(LedgerImbalance { report }) }
    }
}

fn add(entry: &mut u64, count: u64) {
    *entry = entry.saturating_add(count);
}

/// The counts of a ledger, displayed as a table.
#[derive(Clone, Debug, PartialEq, Eq, bincode::Encode, bincode::Decode)]
pub struct LedgerReport<R: Reason> {
    /// Number of samples that were taken.
    pub sampled: u64,
    /// Number of samples that reached the result.
    pub accumulated: u64,
    /// Number of samples that were flagged or lost, by reason.
    pub left_out: BTreeMap<R, u64>,
}

impl<R: Reason> Default for LedgerReport<R> {
    fn default() -> Self {
        Self { sampled: 0, accumulated: 0, left_out: BTreeMap::new() }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
struct Loss {
    stage: &'static str,
    reason: &'static str,
    count: u64,
}

impl<R: Reason> LedgerReport<R> {
    fn leave_out(&mut self, reason: R, count: u64) {
        // No entries of zero, so that equal counts compare equal.
        if count > 0 {
            add(self.left_out.entry(reason).or_default(), count);
        }
    }

    /// Merges the ledgers of two readings of the same samples, each of which accumulated some of them, such as those of other channels.
    ///
    /// Counts of reasons for which `is_of_reading` holds are of one reading only and added. Other counts are common and taken
    /// once. Samples that neither reading accumulated count under `elsewhere`.
    #[must_use]
    #[doc(hidden)]
    pub fn merge_readings(&self, other: &Self, is_of_reading: impl Fn(R) -> bool, elsewhere: R) -> Self {
        let mut both = self.clone();
        add(&mut both.accumulated, other.accumulated);
        for (&reason, &count) in &other.left_out {
            if is_of_reading(reason) {
                both.leave_out(reason, count);
            } else {
                both.left_out.entry(reason).or_insert(count);
            }
        }
        both.left_out.remove(&elsewhere);
        let rest = both.unaccounted();
        both.leave_out(elsewhere, u64::try_from(rest).unwrap_or(0));
        both
    }

    /// Number of samples left out for one reason.
    #[must_use]
    pub fn count(&self, reason: R) -> u64 {
        self.left_out.get(&reason).copied().unwrap_or(0)
    }

    fn total(&self, lost: bool) -> u128 {
        let entries = self.left_out.iter().filter(|(reason, _)| reason.lost_in().is_some() == lost);
        entries.map(|(_, &count)| u128::from(count)).sum()
    }

    /// Number of samples flagged for any reason.
    #[must_use]
    pub fn flagged_total(&self) -> u128 {
        self.total(false)
    }

    /// Number of samples lost in any stage.
    #[must_use]
    pub fn lost_total(&self) -> u128 {
        self.total(true)
    }

    /// Number of samples without an entry; negative if the entries exceed the samples.
    #[must_use]
    #[doc(hidden)]
    pub fn unaccounted(&self) -> i128 {
        let known = u128::from(self.accumulated) + self.flagged_total() + self.lost_total();
        // Each entry is at most u64::MAX, so that it takes 2^63 entries to leave the range.
        i128::from(self.sampled) - i128::try_from(known).unwrap_or(i128::MAX)
    }

    /// Counts of flagged samples, sorted by the text of the reason.
    fn flagged(&self) -> BTreeMap<&'static str, u64> {
        let flags = self.left_out.iter().filter(|(reason, _)| reason.lost_in().is_none());
        flags.map(|(reason, &count)| (reason.text(), count)).collect()
    }

    /// Entries for lost samples, sorted by stage and text of the reason.
    fn losses(&self) -> Vec<Loss> {
        let loss = |(reason, &count): (&R, &u64)| {
            reason.lost_in().map(|stage| Loss { stage, reason: reason.text(), count })
        };
        let mut losses: Vec<Loss> = self.left_out.iter().filter_map(loss).collect();
        losses.sort_unstable();
        losses
    }

    fn rows(&self) -> Vec<(String, u64)> {
        let mut rows =
            vec![("sampled".to_owned(), self.sampled), ("accumulated".to_owned(), self.accumulated)];
        rows.extend(self.flagged().into_iter().map(|(reason, count)| (format!("flagged: {reason}"), count)));
        let lost = |Loss { stage, reason, count }: Loss| (format!("lost in {stage}: {reason}"), count);
        rows.extend(self.losses().into_iter().map(lost));
        rows
    }
}

impl<R: Reason> Serialize for LedgerReport<R> {
    /// Serialises `sampled`, `accumulated`, `flagged` by reason, and `lost` by stage and reason.
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut report = serializer.serialize_struct("LedgerReport", 4)?;
        report.serialize_field("sampled", &self.sampled)?;
        report.serialize_field("accumulated", &self.accumulated)?;
        report.serialize_field("flagged", &self.flagged())?;
        report.serialize_field("lost", &self.losses())?;
        report.end()
    }
}

impl<R: Reason> fmt::Display for LedgerReport<R> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let rows = self.rows();
        let width = rows.iter().map(|(name, _)| name.chars().count()).max().unwrap_or(0);
        for (name, count) in rows {
            writeln!(f, "{name:<width$}  {count:>14}")?;
        }
        write!(f, "{:<width$}  {:>14}", "unaccounted", self.unaccounted())
    }
}

/// Counts of a run that do not balance, which is a bug of the program.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error(
    "the ledger does not balance, which is a bug of the program: {} samples unaccounted for ({}); expected sampled = \
    accumulated + flagged + lost",
    report.unaccounted(),
    entries(report)
)]
pub struct LedgerImbalance<R: Reason> {
    /// All counts.
    pub report: LedgerReport<R>,
}

fn entries<R: Reason>(report: &LedgerReport<R>) -> String {
    let rows: Vec<String> = report.rows().iter().map(|(name, count)| format!("{name} {count}")).collect();
    rows.join(", ")
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
    enum Why {
        Saturated,
        Interference,
        Checksum,
        Gap,
        StoreFull,
    }

    const REASONS: [Why; 5] = [Why::Saturated, Why::Interference, Why::Checksum, Why::Gap, Why::StoreFull];

    impl Reason for Why {
        fn text(self) -> &'static str {
            match self {
                Self::Saturated => "saturated",
                Self::Interference => "interference",
                Self::Checksum => "checksum",
                Self::Gap => "gap",
                Self::StoreFull => "full",
            }
        }

        fn lost_in(self) -> Option<&'static str> {
            match self {
                Self::Saturated | Self::Interference => None,
                Self::Checksum | Self::Gap => Some("decode"),
                Self::StoreFull => Some("a store"),
            }
        }
    }

    /// Batches of samples: accumulated, or left out for a reason.
    fn fates() -> impl Strategy<Value = Vec<(Option<Why>, u64)>> {
        let fate = proptest::option::weighted(0.8, proptest::sample::select(&REASONS[..]));
        proptest::collection::vec((fate, 0..1_000_000_u64), 0..40)
    }

    fn post(ledger: &Ledger<Why>, fate: Option<Why>, count: u64) {
        match fate {
            None => ledger.add_accumulated(count),
            Some(reason) => ledger.add_left_out(reason, count),
        }
    }

    proptest! {
        #[test]
        fn closes_exactly_if_every_sample_has_a_fate(fates in fates(), missing in -3_i64..=3) {
            let ledger = Ledger::new();
            let total: u64 = fates.iter().map(|&(_, count)| count).sum();
            prop_assume!(total >= 3);
            ledger.add_sampled(total.checked_add_signed(missing).unwrap());
            for &(fate, count) in &fates {
                post(&ledger, fate, count);
            }
            match ledger.balanced_report() {
                Ok(report) => {
                    prop_assert_eq!(missing, 0);
                    let known = u128::from(report.accumulated) + report.flagged_total() + report.lost_total();
                    prop_assert_eq!(u128::from(total), known);
                }
                Err(imbalance) => {
                    prop_assert_ne!(missing, 0);
                    prop_assert_eq!(imbalance.report.unaccounted(), i128::from(missing));
                    for (name, count) in imbalance.report.rows() {
                        let entry = format!("{name} {count}");
                        prop_assert!(imbalance.to_string().contains(&entry));
                    }
                }
            }
        }

        #[test]
        fn the_order_of_posts_and_the_threads_do_not_matter(fates in fates()) {
            let (forward, together) = (Ledger::new(), Ledger::new());
            for &(fate, count) in &fates {
                post(&forward, fate, count);
            }
            std::thread::scope(|scope| {
                for part in fates.chunks(7) {
                    let shared = together.clone();
                    scope.spawn(move || {
                        part.iter().rev().for_each(|&(fate, count)| post(&shared, fate, count));
                    });
                }
            });
            prop_assert_eq!(forward.report(), together.report());
        }
    }

    #[test]
    fn forged_counts_saturate() {
        let ledger = Ledger::new();
        ledger.add_left_out(Why::Gap, u64::MAX);
        ledger.add_left_out(Why::Gap, u64::MAX);
        ledger.add_left_out(Why::Checksum, u64::MAX);
        assert_eq!(ledger.report().unaccounted(), -2 * i128::from(u64::MAX));
        assert!(ledger.balanced_report().is_err());
    }

    #[test]
    fn the_report_is_shown_and_serialised() {
        let ledger = Ledger::new();
        ledger.add_sampled(20);
        ledger.add_accumulated(6);
        for (reason, count) in REASONS.into_iter().zip([3, 2, 4, 0, 5]) {
            ledger.add_left_out(reason, count);
        }
        let report = ledger.balanced_report().unwrap();
        let rows: Vec<(String, u64)> = report.rows();
        let rows: Vec<(&str, u64)> = rows.iter().map(|(name, count)| (name.as_str(), *count)).collect();
        let expected = [
            ("sampled", 20),
            ("accumulated", 6),
            ("flagged: interference", 2),
            ("flagged: saturated", 3),
            ("lost in a store: full", 5),
            ("lost in decode: checksum", 4),
        ];
        assert_eq!(rows, expected);
        let table = report.to_string();
        let last: Vec<&str> = table.lines().last().unwrap().split_whitespace().collect();
        assert_eq!((table.lines().count(), last), (7, vec!["unaccounted", "0"]));
        let expected = serde_json::json!({
            "sampled": 20,
            "accumulated": 6,
            "flagged": { "interference": 2, "saturated": 3 },
            "lost": [
                { "stage": "a store", "reason": "full", "count": 5 },
                { "stage": "decode", "reason": "checksum", "count": 4 },
            ],
        });
        assert_eq!(serde_json::to_value(&report).unwrap(), expected);
    }
}
