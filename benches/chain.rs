//! The whole chain against the one kernel that it cannot do without.
//!
//! Runs a mission of a few seconds from sky to map, in process, and compares its rate with that of the
//! symmetric rank-k updates alone on matrices of the same size, measured just before and after: the share
//! of the time that the machine spends on what no pixel engine can avoid.

use std::time::Instant;

use lunarray::imaging::{ColumnBlock, SymmetricTiles};
use lunarray::pipeline::{ConfigSource, Plan, run};
use lunarray::runtime::Cancel;
use lunarray::sky::healpix::pixel_count;

/// Rows of a rank-k update, as the engine makes them: 128 visibilities.
const COLUMNS: usize = 256;

/// Visibilities a second that rank-k updates alone would allow at this nside.
fn rank_k_limit(nside: usize) -> f64 {
    let pixels = pixel_count(nside);
    let stride = pixels + 16;
    let a: Vec<f64> = (0..stride * COLUMNS).map(|k| (k as f64 * 0.37).sin()).collect();
    let mut matrix = SymmetricTiles::zeros(pixels);
    let update = |matrix: &mut SymmetricTiles| {
        matrix.add_products_f64(ColumnBlock { values: &a, columns: COLUMNS, stride });
    };
    update(&mut matrix);
    let rounds = 10;
    let since = Instant::now();
    for _ in 0..rounds {
        update(&mut matrix);
    }
    (rounds * COLUMNS / 2) as f64 / since.elapsed().as_secs_f64()
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let overrides = [
        "spacecraft.channels_hz=[3e6]",
        "spacecraft.every_nth_integration=2",
        "spacecraft.every_nth_window=200",
        "map.epsilon=1e-4",
        "map.snapshot_every_s=0.0",
        "products.pictures=false",
    ];
    let overrides = overrides.map(str::to_owned).to_vec();
    let config = ConfigSource { overrides, ..ConfigSource::default() }.load()?;
    let nside = config.map.nside;
    let plan = Plan::new(config)?;
    let out = std::env::temp_dir().join(format!("lunarray-bench-{}", std::process::id()));
    println!("{} threads, nside {nside}, one channel at 3 MHz", rayon::current_num_threads());
    let mut shares = Vec::new();
    for round in 1..=5 {
        let before = rank_k_limit(nside);
        let since = Instant::now();
        let summary = run(&plan, &out, &Cancel::new(), &mut |_: lunarray::pipeline::RunView| {})?;
        let elapsed_s = since.elapsed().as_secs_f64();
        let limit = 0.5 * (before + rank_k_limit(nside));
        let rate = summary.ledger.accumulated as f64 / elapsed_s;
        let share = rate / limit;
        let count = summary.ledger.accumulated;
        println!(
            "run {round}: {count} visibilities in {elapsed_s:.2} s: {rate:.0} a second; rank-k alone \
             {limit:.0}: {:.0} %",
            100.0 * share
        );
        shares.push(share);
    }
    std::fs::remove_dir_all(&out)?;
    shares.sort_by(f64::total_cmp);
    println!("median: {:.0} % of the rank-k limit, from sky to map", 100.0 * shares[shares.len() / 2]);
    Ok(())
}
