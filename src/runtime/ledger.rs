//! The account that every run closes with: sampled = accumulated + flagged + lost.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};

use serde::Serialize;
use thiserror::Error;

type Label = Cow<'static, str>;

#[derive(Debug, Default)]
struct Accounts {
    sampled: u64,
    accumulated: u64,
    flagged: BTreeMap<Label, u64>,
    lost: BTreeMap<(Label, Label), u64>,
}

/// Counts what came in and what became of it. Clones share one account.
///
/// Counts saturate at `u64::MAX`. Posting takes a lock: post by block, not by sample.
#[derive(Clone, Debug, Default)]
pub struct Ledger(Arc<Mutex<Accounts>>);

impl Ledger {
    /// A ledger without entries.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Posts all that another account reports.
    pub fn post_report(&self, report: &LedgerReport) {
        self.sampled(report.sampled);
        self.accumulated(report.accumulated);
        for (reason, &count) in &report.flagged {
            self.flagged(reason.clone(), count);
        }
        for Loss { stage, reason, count } in &report.lost {
            self.lost(stage.clone(), reason.clone(), *count);
        }
    }

    /// Takes all that another account reports off this one, where it stands; empty accounts go.
    pub fn withdraw(&self, report: &LedgerReport) {
        let mut accounts = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let Accounts { sampled, accumulated, flagged, lost } = &mut *accounts;
        *sampled = sampled.saturating_sub(report.sampled);
        *accumulated = accumulated.saturating_sub(report.accumulated);
        for (reason, &count) in &report.flagged {
            if let Some(account) = flagged.get_mut(reason.as_str()) {
                *account = account.saturating_sub(count);
            }
        }
        for Loss { stage, reason, count } in &report.lost {
            if let Some(account) = lost.get_mut(&(stage.clone().into(), reason.clone().into())) {
                *account = account.saturating_sub(*count);
            }
        }
        flagged.retain(|_, count| *count > 0);
        lost.retain(|_, count| *count > 0);
    }

    /// The accounts as they stand, which begin anew.
    #[must_use]
    pub fn take(&self) -> LedgerReport {
        let report = self.report();
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = Accounts::default();
        report
    }

    /// Posts `count` samples that came into being.
    pub fn sampled(&self, count: u64) {
        self.post(|accounts| &mut accounts.sampled, count);
    }

    /// Posts `count` samples that reached the result.
    pub fn accumulated(&self, count: u64) {
        self.post(|accounts| &mut accounts.accumulated, count);
    }

    /// Posts `count` samples left out on purpose, for `reason`.
    pub fn flagged(&self, reason: impl Into<Label>, count: u64) {
        let reason = reason.into();
        self.post(|accounts| accounts.flagged.entry(reason).or_default(), count);
    }

    /// Posts `count` samples that got lost in `stage`, for `reason`.
    pub fn lost(&self, stage: impl Into<Label>, reason: impl Into<Label>, count: u64) {
        let key = (stage.into(), reason.into());
        self.post(|accounts| accounts.lost.entry(key).or_default(), count);
    }

    fn post(&self, account: impl FnOnce(&mut Accounts) -> &mut u64, count: u64) {
        if count == 0 {
            return; // Leaves no empty account behind.
        }
        let mut accounts = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let account = account(&mut accounts);
        *account = account.saturating_add(count);
    }

    /// The accounts as they stand, balanced or not.
    #[must_use]
    pub fn report(&self) -> LedgerReport {
        let accounts = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let flagged = accounts.flagged.iter().map(|(reason, &count)| (reason.to_string(), count)).collect();
        let lost = accounts
            .lost
            .iter()
            .map(|((stage, reason), &count)| Loss {
                stage: stage.to_string(),
                reason: reason.to_string(),
                count,
            })
            .collect();
        LedgerReport { sampled: accounts.sampled, accumulated: accounts.accumulated, flagged, lost }
    }

    /// Closes the account.
    ///
    /// # Errors
    /// [`LedgerImbalance`] if what came in is not what became of it.
    pub fn close(&self) -> Result<LedgerReport, LedgerImbalance> {
        let report = self.report();
        if report.unaccounted() == 0 { Ok(report) } else { Err(LedgerImbalance { report }) }
    }
}

/// Samples lost in one stage for one reason.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, bincode::Encode, bincode::Decode)]
pub struct Loss {
    /// Where.
    pub stage: String,
    /// Why.
    pub reason: String,
    /// How many.
    pub count: u64,
}

/// The accounts of a run; shown as a table.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, bincode::Encode, bincode::Decode)]
pub struct LedgerReport {
    /// Samples that came into being.
    pub sampled: u64,
    /// Samples that reached the result.
    pub accumulated: u64,
    /// Samples left out on purpose, by reason.
    pub flagged: BTreeMap<String, u64>,
    /// Samples lost, by stage and reason.
    pub lost: Vec<Loss>,
}

impl LedgerReport {
    /// Samples flagged for any reason.
    #[must_use]
    pub fn flagged_total(&self) -> u128 {
        self.flagged.values().map(|&count| u128::from(count)).sum()
    }

    /// Samples lost anywhere.
    #[must_use]
    pub fn lost_total(&self) -> u128 {
        self.lost.iter().map(|loss| u128::from(loss.count)).sum()
    }

    /// Samples of which nothing is known; negative if more is known than there were.
    #[must_use]
    pub fn unaccounted(&self) -> i128 {
        let known = u128::from(self.accumulated) + self.flagged_total() + self.lost_total();
        // A u64 per account: 2^63 accounts would have to be full to leave the range.
        i128::from(self.sampled) - i128::try_from(known).unwrap_or(i128::MAX)
    }

    fn rows(&self) -> Vec<(String, u64)> {
        let mut rows =
            vec![("sampled".to_owned(), self.sampled), ("accumulated".to_owned(), self.accumulated)];
        rows.extend(self.flagged.iter().map(|(reason, &count)| (format!("flagged: {reason}"), count)));
        let lost = |loss: &Loss| (format!("lost in {}: {}", loss.stage, loss.reason), loss.count);
        rows.extend(self.lost.iter().map(lost));
        rows
    }
}

impl fmt::Display for LedgerReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let rows = self.rows();
        let width = rows.iter().map(|(name, _)| name.chars().count()).max().unwrap_or(0);
        for (name, count) in rows {
            writeln!(f, "{name:<width$}  {count:>14}")?;
        }
        write!(f, "{:<width$}  {:>14}", "unaccounted", self.unaccounted())
    }
}

/// The accounts of a run do not balance: a bug of the program.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error(
    "the ledger does not close: {} samples unaccounted for ({}); expected sampled = accumulated + flagged + \
     lost",
    report.unaccounted(),
    accounts(report)
)]
pub struct LedgerImbalance {
    /// All accounts.
    pub report: LedgerReport,
}

fn accounts(report: &LedgerReport) -> String {
    let rows: Vec<String> = report.rows().iter().map(|(name, count)| format!("{name} {count}")).collect();
    rows.join(", ")
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const REASONS: [&str; 3] = ["interference", "saturated", "no ephemeris"];

    /// What became of a batch of samples.
    #[derive(Clone, Copy, Debug)]
    enum Fate {
        Accumulated,
        Flagged(usize),
        Lost(usize, usize),
    }

    fn fates() -> impl Strategy<Value = Vec<(Fate, u64)>> {
        let fate = prop_oneof![
            Just(Fate::Accumulated),
            (0..REASONS.len()).prop_map(Fate::Flagged),
            (0..2_usize, 0..REASONS.len()).prop_map(|(stage, reason)| Fate::Lost(stage, reason)),
        ];
        proptest::collection::vec((fate, 0..1_000_000_u64), 0..40)
    }

    fn post(ledger: &Ledger, fate: Fate, count: u64) {
        match fate {
            Fate::Accumulated => ledger.accumulated(count),
            Fate::Flagged(reason) => ledger.flagged(REASONS[reason], count),
            Fate::Lost(stage, reason) => ledger.lost(format!("stage {stage}"), REASONS[reason], count),
        }
    }

    proptest! {
        #[test]
        fn closes_exactly_if_every_sample_has_a_fate(fates in fates(), missing in -3_i64..=3) {
            let ledger = Ledger::new();
            let total: u64 = fates.iter().map(|&(_, count)| count).sum();
            prop_assume!(total >= 3);
            ledger.sampled(total.checked_add_signed(missing).unwrap());
            for &(fate, count) in &fates {
                post(&ledger, fate, count);
            }
            match ledger.close() {
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

    proptest! {
        #[test]
        fn what_is_withdrawn_was_never_there(first in fates(), second in fates()) {
            let (ledger, alone, part) = (Ledger::new(), Ledger::new(), Ledger::new());
            for (fates, to) in [(&first, [&ledger, &alone]), (&second, [&ledger, &part])] {
                for &(fate, count) in fates {
                    to.iter().for_each(|ledger| post(ledger, fate, count));
                }
            }
            ledger.withdraw(&part.take());
            prop_assert_eq!(ledger.report(), alone.report());
            prop_assert_eq!(part.report(), LedgerReport::default());
        }
    }

    #[test]
    fn forged_counts_saturate() {
        let ledger = Ledger::new();
        ledger.lost("decode", "gap", u64::MAX);
        ledger.lost("decode", "gap", u64::MAX);
        ledger.lost("decode", "checksum", u64::MAX);
        assert_eq!(ledger.report().unaccounted(), -2 * i128::from(u64::MAX));
        assert!(ledger.close().is_err());
    }

    #[test]
    fn the_report_is_shown_and_serialised() {
        let ledger = Ledger::new();
        ledger.sampled(10);
        ledger.accumulated(6);
        ledger.flagged("saturated", 3);
        ledger.lost("decode", "checksum", 1);
        let report = ledger.close().unwrap();
        let table = report.to_string();
        let lines: Vec<Vec<&str>> = table.lines().map(|line| line.split_whitespace().collect()).collect();
        assert_eq!(lines[0], ["sampled", "10"]);
        assert_eq!(lines[3], ["lost", "in", "decode:", "checksum", "1"]);
        assert_eq!(lines[4], ["unaccounted", "0"]);
        let json = serde_json::to_value(&report).unwrap();
        assert_eq!(json["flagged"]["saturated"], 3);
        assert_eq!(json["lost"][0]["stage"], "decode");
    }
}
