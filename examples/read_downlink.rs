//! Reads a downlink file into arrays: time, position of both satellites, visibility, weight.
//!
//! `cargo run --release --example read_downlink [FILE]`; without a file it simulates one.

mod common;

use std::error::Error;
use std::path::PathBuf;

use lunarray::array::Ephemeris;
use lunarray::downlink::{Contents, DownlinkReader};
use lunarray::frames::GroundFrame;
use lunarray::units::vector::Vec3;
use num_complex::Complex32;

/// The visibilities of one channel, an entry each.
#[derive(Default)]
struct Arrays {
    time_s: Vec<f64>,
    r_i_m: Vec<Vec3>,
    r_j_m: Vec<Vec3>,
    value_k_sr: Vec<Complex32>,
    weight: Vec<f32>,
}

fn main() -> Result<(), Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    let file = match std::env::args().nth(1) {
        Some(file) => PathBuf::from(file),
        None => {
            let file = folder.path().join("small.ccsds");
            common::small_downlink(&file)?;
            file
        }
    };
    // What `lunarray inspect` prints.
    let contents = Contents::read(&file)?;
    println!("{} bytes, {} visibilities", contents.bytes, contents.visibilities.count);

    // Positions are sent apart from visibilities, and interpolated.
    let (mut ephemeris, mut channels) = (Ephemeris::default(), Vec::new());
    let mut reader = DownlinkReader::open(&file)?;
    while let Some(frame) = reader.next_frame()? {
        match frame {
            GroundFrame::Instrument(instrument) => {
                channels.resize_with(instrument.channels.len(), Arrays::default);
            }
            GroundFrame::Ephemeris(segment) => {
                ephemeris.insert(segment);
            }
            GroundFrame::Visibilities(block) => {
                let arrays = channels.get_mut(usize::from(block.channel.0)).ok_or("an unknown channel")?;
                for k in (0..block.len()).filter(|&k| block.flags[k].is_good()) {
                    let time_s = block.middle_s(k);
                    let position = |satellite: u8| ephemeris.position_at(time_s, usize::from(satellite));
                    // A pair of a satellite with itself is an auto-correlation.
                    let (Some(r_i_m), Some(r_j_m)) = (position(block.pair.i), position(block.pair.j)) else {
                        continue;
                    };
                    arrays.time_s.push(time_s);
                    arrays.r_i_m.push(r_i_m);
                    arrays.r_j_m.push(r_j_m);
                    arrays.value_k_sr.push(block.value_k_sr[k]);
                    arrays.weight.push(block.weight[k]);
                }
            }
            GroundFrame::Housekeeping(_) => {}
        }
    }

    for (number, arrays) in channels.iter().enumerate() {
        let of_days = arrays.time_s.last().map_or(0.0, |time_s| time_s / 86_400.0);
        println!("channel {number}: {} visibilities up to day {of_days:.1}", arrays.time_s.len());
    }
    let placed: usize = channels.iter().map(|arrays| arrays.weight.len()).sum();
    if placed == 0 { Err("no visibility could be placed".into()) } else { Ok(()) }
}
