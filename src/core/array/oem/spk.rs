//! SPK kernels: ephemerides of NAIF's SPICE, in files of the kind DAF/SPK.
//!
//! The layout is that of NAIF's "DAF Required Reading" and "SPK Required Reading". States of spacecraft are kept as they are, polynomials
//! of Chebyshev as states, so that they are interpolated and checked as those of OEM files.

use super::form::Fault;
use super::message::{OemMessage, OemSegment, Reading, TableMethod};
use crate::array::axes::turned;
use crate::units::time_scales::{Tai, TimeScale};
use crate::units::vector::{Vec3, scale};

/// Bytes of a record, and of a word.
const RECORD_BYTES: usize = 1024;
const WORD_BYTES: usize = 8;

/// Words of a segment's summary: two times, and six integers in pairs.
const SUMMARY_WORDS: usize = 5;

/// NAIF's number of the Moon.
const MOON: i32 = 301;

/// Most segments of a kernel.
const SEGMENTS_MAX: usize = 10_000;

/// Farthest time of a segment, s from J2000: 300 years.
const TIME_S_MAX: f64 = 1e10;

/// Greatest degree of an interpolation, that of NAIF's toolkit.
const DEGREE_MAX: usize = 27;

/// Whether a file begins as a DAF, of whatever kind, or as its form in text.
pub(super) fn is_daf(bytes: &[u8]) -> bool {
    ["DAF/", "NAIF/DAF", "DAFETF"].iter().any(|name| bytes.starts_with(name.as_bytes()))
}

/// The orbits about the Moon in a kernel.
#[derive(Debug)]
pub(super) struct Kernel {
    /// NAIF's number of each object, in order of appearance, and its states.
    pub(super) objects: Vec<(i32, Reading)>,
    /// Segments about other centres, which are passed over.
    pub(super) other_centres: usize,
}

/// Reads a kernel. Lines of faults and states are segments, from 1.
///
/// # Errors
/// The first segment that cannot be used.
pub(super) fn read(bytes: &[u8]) -> Result<Kernel, Fault> {
    let daf = Daf::new(bytes)?;
    let all = daf.summaries()?;
    let about_moon: Vec<&Summary> = all.iter().filter(|summary| summary.centre == MOON).collect();
    if about_moon.is_empty() {
        let found: Vec<String> =
            all.iter().take(8).map(|s| format!("{} about {}", s.object, s.centre)).collect();
        let expected = "an object about the Moon (301), such as states by `spkezr(.., observer = \"MOON\")` written by `spkw13` or as OEM";
        return Err(Fault::new(0, format!("the objects {}", found.join(", ")), expected));
    }
    let mut ids: Vec<i32> = Vec::new();
    for summary in &about_moon {
        if !ids.contains(&summary.object) {
            ids.push(summary.object);
        }
    }
    let objects = ids.into_iter().map(|id| {
        let own: Vec<&Summary> = about_moon.iter().copied().filter(|summary| summary.object == id).collect();
        Ok((id, daf.reading(&own)?))
    });
    Ok(Kernel {
        objects: objects.collect::<Result<_, Fault>>()?,
        other_centres: all.len() - about_moon.len(),
    })
}

/// What a kernel says of a segment.
#[derive(Clone, Copy, Debug)]
struct Summary {
    /// From 1.
    number: usize,
    /// Seconds of TDB since J2000.
    covered_s: [f64; 2],
    object: i32,
    centre: i32,
    frame: i32,
    kind: i32,
    /// First and last word, from 1.
    words: [usize; 2],
}

impl Summary {
    fn fault(&self, found: impl Into<String>, expected: impl Into<String>) -> Fault {
        Fault::new(self.number, found, expected)
    }
}

/// A double precision array file.
struct Daf<'a> {
    bytes: &'a [u8],
    is_big: bool,
}

impl<'a> Daf<'a> {
    fn new(bytes: &'a [u8]) -> Result<Self, Fault> {
        let name = String::from_utf8_lossy(bytes.get(..8).unwrap_or(bytes)).trim().to_owned();
        let expected = "a binary SPK kernel, DAF/SPK; NAIF's `tobin` makes one of its form in text";
        if !["DAF/SPK", "NAIF/DAF"].contains(&name.as_str()) {
            return Err(Fault::new(0, format!("{name:?}"), expected));
        }
        let daf = |is_big| Self { bytes, is_big };
        let sizes = |daf: &Self| (daf.integer(8), daf.integer(12)) == (Some(2), Some(6));
        let form =
            bytes.get(88..96).map(|form| String::from_utf8_lossy(form).trim().to_owned()).unwrap_or_default();
        match [daf(false), daf(true)].into_iter().find(sizes) {
            Some(daf) if !form.starts_with("VAX") => Ok(daf),
            _ => Err(Fault::new(
                0,
                format!("numbers of the form {form:?}"),
                "LTL-IEEE or BIG-IEEE, as `bingo` makes it",
            )),
        }
    }

    fn integer(&self, at: usize) -> Option<i32> {
        let four = *self.bytes.get(at..)?.first_chunk()?;
        Some(if self.is_big { i32::from_be_bytes(four) } else { i32::from_le_bytes(four) })
    }

    /// A word, from 1.
    fn word(&self, number: usize) -> Option<f64> {
        let eight = *self.bytes.get(number.checked_sub(1)?.checked_mul(WORD_BYTES)?..)?.first_chunk()?;
        Some(if self.is_big { f64::from_be_bytes(eight) } else { f64::from_le_bytes(eight) })
    }

    /// The summaries of all segments, in their order.
    fn summaries(&self) -> Result<Vec<Summary>, Fault> {
        let mut found = Vec::new();
        let mut record = self.integer(76).unwrap_or(0) as f64;
        let records = self.bytes.len() / RECORD_BYTES;
        // Each record of summaries is read once at most.
        for _ in 0..records {
            let cut = || {
                let record = format!("summaries in record {record} of {records}");
                Fault::new(found.len(), record, "the whole kernel, as it was written")
            };
            let Some(before) = count(Some(&record), records).ok_or_else(cut)?.checked_sub(1) else { break };
            let first = before * (RECORD_BYTES / WORD_BYTES) + 1;
            let (Some(next), Some(count)) = (self.word(first), self.word(first + 2)) else {
                return Err(cut());
            };
            let most = RECORD_BYTES / WORD_BYTES / SUMMARY_WORDS;
            for k in 0..(count as usize).min(most) {
                let number = found.len() + 1;
                let summary = self.summary(first + 3 + k * SUMMARY_WORDS, number);
                let fault = || {
                    Fault::new(
                        number,
                        "numbers that are not in the file",
                        "the whole kernel, as it was written",
                    )
                };
                found.push(summary.filter(|summary| self.holds(summary)).ok_or_else(fault)?);
            }
            record = next;
        }
        // Segments of their own numbers, so that they are not longer together than the file.
        let words: usize = found.iter().map(|summary| 1 + summary.words[1] - summary.words[0]).sum();
        if found.len() > SEGMENTS_MAX || words > self.bytes.len() / WORD_BYTES {
            let found = format!("{} segments of {words} numbers", found.len());
            let expected = format!("at most {SEGMENTS_MAX}, each with numbers of its own");
            return Err(Fault::new(0, found, expected));
        }
        Ok(found)
    }

    fn holds(&self, summary: &Summary) -> bool {
        let Summary { covered_s, words: [first, last], .. } = *summary;
        let is_time = |s: f64| s.abs() <= TIME_S_MAX;
        0 < first
            && first <= last
            && last <= self.bytes.len() / WORD_BYTES
            && covered_s.into_iter().all(is_time)
    }

    fn summary(&self, first: usize, number: usize) -> Option<Summary> {
        let integer = |k: usize| self.integer((first + 1) * WORD_BYTES + 4 * k);
        let word = |k: usize| usize::try_from(integer(k)?).ok();
        Some(Summary {
            number,
            covered_s: [self.word(first)?, self.word(first + 1)?],
            object: integer(0)?,
            centre: integer(1)?,
            frame: integer(2)?,
            kind: integer(3)?,
            words: [word(4)?, word(5)?],
        })
    }

    /// The orbit of an object by its segments. Where they overlap, the last counts.
    fn reading(&self, summaries: &[&Summary]) -> Result<Reading, Fault> {
        let mut zero = None;
        let mut parts: Vec<(OemSegment, usize)> = Vec::new();
        let mut covered: Vec<[f64; 2]> = Vec::new();
        for summary in summaries.iter().rev() {
            let states = self.states(summary)?;
            let zero = *zero.get_or_insert_with(|| Tai::of_tdb(summary.covered_s[0]).floor_second());
            let segment = states.segment(summary, zero)?;
            for left_s in without(segment.useable_s, &covered) {
                parts.push((part_of(&segment, left_s), summary.number));
            }
            covered.push(segment.useable_s);
        }
        if let (true, Some(first)) = (parts.is_empty(), summaries.first()) {
            return Err(first.fault("no states in the time that it covers", "two states or more"));
        }
        parts.sort_by(|(a, _), (b, _)| a.useable_s[0].total_cmp(&b.useable_s[0]));
        let lines = |(segment, number): &(OemSegment, usize)| vec![*number as u32; segment.time_s.len()];
        Ok(Reading {
            lines: parts.iter().map(lines).collect(),
            message: OemMessage {
                zero: zero.unwrap_or_else(|| Tai::of_tdb(0.0)),
                segments: parts.into_iter().map(|(segment, _)| segment).collect(),
            },
            scale: TimeScale::Tdb,
            covariances: 0,
        })
    }

    /// The states of a segment.
    fn states(&self, summary: &Summary) -> Result<States, Fault> {
        let [first, last] = summary.words;
        let words: Vec<f64> = (first..=last).filter_map(|word| self.word(word)).collect();
        if !words.iter().all(|word| word.is_finite()) {
            return Err(summary.fault("a value that is no number", "finite numbers"));
        }
        let states = match summary.kind {
            2 | 3 => chebyshev(&words, summary.kind == 3),
            8 | 12 => even_states(&words, summary.kind == 12),
            9 | 13 => states_at_times(&words, summary.kind == 13),
            other => {
                let expected = "type 2 or 3 (Chebyshev), 8 or 9 (Lagrange), 12 or 13 (Hermite); NAIF's toolkit gives states of others: \
                                `spkezr`, then `spkw13`";
                return Err(summary.fault(format!("a segment of type {other}"), expected));
            }
        };
        let expected =
            format!("a segment of type {}: counts, degrees and steps that fit its length", summary.kind);
        states.ok_or_else(|| {
            summary.fault(format!("{} numbers that contradict each other", words.len()), expected)
        })
    }
}

/// States of a segment, on its own axes, km and km/s.
struct States {
    method: TableMethod,
    degree: usize,
    /// Seconds of TDB since J2000.
    time_s: Vec<f64>,
    states: Vec<[f64; 6]>,
}

impl States {
    /// The segment on ecliptic axes and TAI.
    fn segment(self, summary: &Summary, zero: Tai) -> Result<OemSegment, Fault> {
        let Self { method, degree, time_s, states } = self;
        let equatorial = match summary.frame {
            1 => true,
            17 => false,
            other => {
                let expected = "1 (J2000) or 17 (ECLIPJ2000): axes that do not turn";
                return Err(summary.fault(format!("a segment on the axes {other}"), expected));
            }
        };
        let since_s = |tdb_s: f64| Tai::of_tdb(tdb_s).since_s(zero);
        let time_s: Vec<f64> = time_s.into_iter().map(since_s).collect();
        if states.len() < 2 || !time_s.is_sorted_by(|a, b| a < b) {
            return Err(
                summary.fault("states that do not follow each other", "two states or more, at rising times")
            );
        }
        let covered_s =
            summary.covered_s.map(|tdb_s| since_s(tdb_s).clamp(time_s[0], time_s[time_s.len() - 1]));
        let on_axes = |of: fn(&[f64; 6]) -> Vec3| -> Vec<Vec3> {
            states.iter().map(|state| turned(equatorial, scale(1e3, of(state)))).collect()
        };
        Ok(OemSegment {
            method,
            degree,
            useable_s: covered_s,
            position_m: on_axes(|s| [s[0], s[1], s[2]]),
            velocity_m_s: on_axes(|s| [s[3], s[4], s[5]]),
            time_s,
        })
    }
}

/// A count that a kernel holds as a floating-point number, up to `most`.
fn count(value: Option<&f64>, most: usize) -> Option<usize> {
    value
        .filter(|value| **value >= 0.0 && **value <= most as f64 && value.fract() == 0.0)
        .map(|value| *value as usize)
}

/// Method and degree of an interpolation: through `size` + 1 states, of which there are `states`.
fn interpolation(size: usize, states: usize, is_hermite: bool) -> Option<(TableMethod, usize)> {
    let (points, method) =
        ((size + 1).min(states), if is_hermite { TableMethod::Hermite } else { TableMethod::Lagrange });
    let degree = if is_hermite { 2 * points } else { points } - 1;
    (points > 0 && degree <= DEGREE_MAX).then_some((method, degree))
}

fn six(words: &[f64]) -> Vec<[f64; 6]> {
    words.as_chunks().0.to_vec()
}

/// Types 8 and 12: states at even steps.
fn even_states(words: &[f64], is_hermite: bool) -> Option<States> {
    let (states, [start_s, step_s, size, number]) = words.split_last_chunk()?;
    let number = count(Some(number), words.len())?;
    let (method, degree) = interpolation(count(Some(size), DEGREE_MAX)?, number, is_hermite)?;
    let time_s = (0..number).map(|k| start_s + k as f64 * step_s).collect();
    (states.len() == 6 * number).then(|| States { method, degree, time_s, states: six(states) })
}

/// Types 9 and 13: states at times of their own.
fn states_at_times(words: &[f64], is_hermite: bool) -> Option<States> {
    let (_, [size, number]) = words.split_last_chunk()?;
    let number = count(Some(number), words.len())?;
    let (method, degree) = interpolation(count(Some(size), DEGREE_MAX)?, number, is_hermite)?;
    let directory = number.checked_sub(1)? / 100;
    let is_whole = words.len() == 7 * number + directory + 2;
    is_whole.then(|| {
        let (states, rest) = words.split_at(6 * number);
        States { method, degree, time_s: rest[..number].to_vec(), states: six(states) }
    })
}

/// Types 2 and 3: polynomials of Chebyshev for stretches of time, of positions or also of velocities. A state for each of their terms
/// holds twice as many numbers as they do.
fn chebyshev(words: &[f64], has_velocities: bool) -> Option<States> {
    let (records, [_, _, size, number]) = words.split_last_chunk()?;
    let (size, number) = (count(Some(size), words.len())?, count(Some(number), words.len())?);
    let columns = if has_velocities { 6 } else { 3 };
    let terms = size.checked_sub(2)? / columns;
    if terms == 0 || size != 2 + columns * terms || number == 0 || records.len() != size * number {
        return None;
    }
    let (mut time_s, mut states) = (Vec::new(), Vec::new());
    for (k, record) in records.chunks_exact(size).enumerate() {
        let (middle_s, radius_s) = (record[0], record[1]);
        let ends = usize::from(k + 1 == number);
        for step in 0..terms + ends {
            let x = 2.0 * step as f64 / terms as f64 - 1.0;
            let of = |column: usize| series(&record[2 + column * terms..][..terms], x);
            time_s.push(middle_s + x * radius_s);
            states.push(std::array::from_fn(|axis| match axis {
                0..3 => of(axis)[0],
                _ if has_velocities => of(axis)[0],
                _ => of(axis - 3)[1] / radius_s,
            }));
        }
    }
    Some(States { method: TableMethod::Hermite, degree: 7, time_s, states })
}

/// A series of Chebyshev's polynomials, and its derivative.
fn series(terms: &[f64], x: f64) -> [f64; 2] {
    // T' of a degree is the degree times U of the one below.
    let (mut t, mut u) = ([1.0, x], [0.0, 1.0]);
    let mut sum = [0.0; 2];
    for (degree, term) in terms.iter().enumerate() {
        sum[0] += term * t[0];
        sum[1] += term * degree as f64 * u[0];
        t = [t[1], 2.0 * x * t[1] - t[0]];
        u = [u[1], 2.0 * x * u[1] - u[0]];
    }
    sum
}

/// What is left of an interval without others.
fn without(whole: [f64; 2], others: &[[f64; 2]]) -> Vec<[f64; 2]> {
    let mut left: Vec<[f64; 2]> = (whole[0] < whole[1]).then_some(whole).into_iter().collect();
    for [from_s, until_s] in others {
        let cut = |[a, b]: [f64; 2]| [[a, b.min(*from_s)], [a.max(*until_s), b]];
        left = left.into_iter().flat_map(cut).filter(|[a, b]| a < b).collect();
    }
    left
}

/// The states of a segment that an interval needs.
fn part_of(segment: &OemSegment, [from_s, until_s]: [f64; 2]) -> OemSegment {
    let around = segment.points() + 4;
    let first = segment.time_s.partition_point(|t_s| *t_s <= from_s).saturating_sub(around);
    let end = (segment.time_s.partition_point(|t_s| *t_s < until_s) + around).min(segment.time_s.len());
    OemSegment {
        useable_s: [from_s, until_s],
        time_s: segment.time_s[first..end].to_vec(),
        position_m: segment.position_m[first..end].to_vec(),
        velocity_m_s: segment.velocity_m_s[first..end].to_vec(),
        ..*segment
    }
}
