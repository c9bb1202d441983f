//! The machine, and its other load during a benchmark.

use serde::Serialize;

/// Fraction of the processors used by other processes above which a benchmark is doubtful.
const OTHERS_MAX: f64 = 0.1;

/// The machine and the program.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Machine {
    /// Name of the processor as reported by the system.
    pub processor: String,
    /// Vector instructions that the program can use.
    pub vector_units: Vec<&'static str>,
    /// Number of worker threads.
    pub threads: usize,
    /// Version of the program.
    pub version: &'static str,
    /// Commit of its source, if `LUNARRAY_COMMIT` was set for its build.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub commit: Option<&'static str>,
    /// Date of the benchmark, UTC.
    pub date: String,
}

impl Machine {
    pub(super) fn new() -> Self {
        Self {
            processor: processor(),
            vector_units: vector_units(),
            threads: rayon::current_num_threads(),
            version: env!("CARGO_PKG_VERSION"),
            commit: option_env!("LUNARRAY_COMMIT"),
            date: chrono::DateTime::<chrono::Utc>::from(std::time::SystemTime::now())
                .format("%Y-%m-%dT%H:%M:%SZ")
                .to_string(),
        }
    }
}

/// Name of the processor, or its architecture if the system does not report a name.
fn processor() -> String {
    let text = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let named = text.lines().find_map(|line| line.strip_prefix("model name")?.split_once(':'));
    named.map_or_else(|| std::env::consts::ARCH.to_owned(), |(_, name)| name.trim().to_owned())
}

#[cfg(target_arch = "x86_64")]
fn vector_units() -> Vec<&'static str> {
    let known = [
        ("AVX-512", is_x86_feature_detected!("avx512f")),
        ("AVX2", is_x86_feature_detected!("avx2")),
        ("FMA", is_x86_feature_detected!("fma")),
    ];
    known.into_iter().filter_map(|(name, has)| has.then_some(name)).collect()
}

#[cfg(not(target_arch = "x86_64"))]
fn vector_units() -> Vec<&'static str> {
    Vec::new()
}

/// Processor time of all processes of the machine, s; `None` where the system does not report it.
pub(super) fn machine_seconds() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/stat").ok()?;
    let fields = text.lines().next()?.split_whitespace().skip(1);
    let ticks: Vec<f64> = fields.map_while(|field| field.parse().ok()).collect();
    // The fields are user, nice, system, idle, iowait, irq, softirq and steal (proc(5)).
    let [user, nice, system, _, _, hard, soft, steal] = *ticks.first_chunk()?;
    Some((user + nice + system + hard + soft + steal) / 100.0)
}

/// Fraction of the processors that other processes used in `seconds`, from the processor times of the machine and of this
/// process.
pub(super) fn share_of_others(seconds: f64, all_s: f64, own_s: f64) -> f64 {
    let processors = std::thread::available_parallelism().map_or(1.0, |count| count.get() as f64);
    ((all_s - own_s) / (seconds * processors).max(1e-9)).clamp(0.0, 1.0)
}

/// Whether other processes used so much that the benchmark is doubtful.
pub(super) fn is_doubtful(share: f64) -> bool {
    share > OTHERS_MAX
}
