//! The mission of the sequences, and the states that they share.

use super::*;

/// Packets by their number, as bits.
pub(super) type Packets = u64;

/// A mission of few packets.
pub(super) struct Mission {
    pub(super) config: GroundConfig,
    pub(super) packets: Vec<Vec<u8>>,
    pub(super) headers: Vec<PacketHeader>,
    /// Window of each packet; `None` for the description of the instrument.
    pub(super) windows: Vec<Option<i64>>,
}

impl Mission {
    pub(super) fn new() -> Self {
        let array = Array::new(&ArrayConfig::default()).unwrap();
        let channel = |frequency_hz| Channel { frequency_hz, width_hz: 8e3 };
        let mut frames = vec![(
            None,
            GroundFrame::Instrument(Instrument {
                name: "test".to_owned(),
                epoch_tai_s: 2_493_072_037.25,
                moon_radius_m: 1_737_100.0,
                satellites: 8,
                channels: vec![channel(1e6), channel(3e6)],
                response: AntennaResponse::Isotropic,
                seed: 7,
                configuration_hash: 1,
                noiseless: false,
                spectrometer: None,
            }),
        )];
        for window in 0..WINDOWS {
            let start = MissionTime::from_seconds((WINDOW_S[0] * window) as f64);
            let end = start.plus_ticks(1_000_000 * WINDOW_S[1]);
            let segments = segments_for(&array, start, end, 60.0);
            frames
                .extend(segments.into_iter().map(|segment| (Some(window), GroundFrame::Ephemeris(segment))));
            for channel in 0..2 {
                let block = |pair| (Some(window), GroundFrame::Visibilities(block(channel, pair, start)));
                frames.extend(PAIRS.map(block));
            }
            let sampled = 24 * (window as u64 + 1);
            let report = Housekeeping { time: end, sampled, dropped: 0 };
            frames.push((Some(window), GroundFrame::Housekeeping(report)));
        }
        // Positions in several packets.
        let config = DownlinkConfig { packet_bytes_max: 2048, ..DownlinkConfig::default() };
        let (frames, of_frames): (Vec<GroundFrame>, Vec<Option<i64>>) =
            frames.into_iter().map(|(window, frame)| (frame, window)).unzip();
        let packets = packets_of(&transmit(&frames, &config));
        let headers: Vec<PacketHeader> =
            packets.iter().map(|packet| PacketHeader::parse(packet).unwrap()).collect();
        // Each report ends a window.
        let mut window = 0;
        let windows: Vec<Option<i64>> = headers
            .iter()
            .map(|header| {
                let of = (header.kind != PacketKind::Instrument).then_some(window);
                window += i64::from(header.kind == PacketKind::Housekeeping);
                of
            })
            .collect();
        assert_eq!(window, of_frames.into_iter().flatten().max().unwrap() + 1);
        assert!(packets.len() <= 64);
        let map = MapConfig { nside: 2, ..MapConfig::default() };
        let (calibration, wait_bytes) = (CalibrationConfig::default(), 1 << 20);
        let config = GroundConfig {
            calibration,
            calibrate: Default::default(),
            map,
            wait_bytes,
            memory_max_bytes: None,
            group: None,
            part: None,
        };
        Self { config, packets, headers, windows }
    }

    pub(super) fn all(&self) -> Packets {
        u64::MAX >> (64 - self.packets.len())
    }

    pub(super) fn having(&self, is_meant: impl Fn(usize) -> bool) -> Packets {
        (0..self.packets.len()).filter(|&k| is_meant(k)).map(|k| 1 << k).sum()
    }

    pub(super) fn of_kind(&self, kind: PacketKind) -> Packets {
        self.having(|k| self.headers[k].kind == kind)
    }

    /// Of a state that has received `held`, the packets of visibilities that wait for the instrument or positions.
    pub(super) fn waiting(&self, held: Packets) -> Packets {
        self.having(|k| {
            let positions =
                self.of_kind(PacketKind::Ephemeris) & self.having(|p| self.windows[p] == self.windows[k]);
            let needed = positions | self.of_kind(PacketKind::Instrument);
            self.headers[k].kind == PacketKind::Visibilities
                && held & (1 << k) != 0
                && held & needed != needed
        })
    }

    pub(super) fn bytes(&self, order: &[usize]) -> Vec<u8> {
        order.iter().flat_map(|&k| self.packets[k].clone()).collect()
    }

    /// The packets that a checkpoint says it has received.
    pub(super) fn received(&self, checkpoint: &Path) -> Packets {
        let survey = CoverageSurvey::read(checkpoint).unwrap();
        let sets = &survey.received().sets;
        self.having(|k| {
            let PacketHeader { kind, count, time, .. } = self.headers[k];
            sets.iter().any(|(of, set)| *of == kind && set.contains(count, time))
        })
    }
}

pub(super) fn block(channel: u16, pair: Pair, start: MissionTime) -> VisibilityBlock {
    let count = 4;
    let spread = f32::from(channel) + f32::from(pair.j) + start.seconds() as f32;
    VisibilityBlock {
        channel: ChannelId(channel),
        pair,
        start,
        offset_ticks: (0..count).map(|k| 300_000_000 * k).collect(),
        duration_ticks: vec![20_000_000; count as usize],
        value_k_sr: (0..count).map(|k| Complex32::new(1e4 + spread, 30.0 * k as f32)).collect(),
        weight: (0..count).map(|k| 1e-6 / (1.0 + k as f32)).collect(),
        flags: vec![Flags::GOOD; count as usize],
    }
}

/// Checksum and length of a checkpoint.
pub(super) type Digest = (u64, usize);

pub(super) fn digest(path: &Path) -> Digest {
    let bytes = std::fs::read(path).unwrap();
    (crc_fast::checksum(crc_fast::CrcAlgorithm::Crc64Nvme, &bytes), bytes.len())
}

/// All that sequences share.
pub(super) struct Bench {
    pub(super) mission: Mission,
    pub(super) folder: tempfile::TempDir,
    /// Checkpoints of states that received a set of packets at once, and what is known to be one.
    pub(super) fresh: HashMap<Packets, Digest>,
    pub(super) steps: HashMap<&'static str, u64>,
}

impl Bench {
    pub(super) fn new() -> Self {
        // In memory where possible: nothing of this has to outlast a loss of power.
        let folder = tempfile::tempdir_in("/dev/shm").or_else(|_| tempfile::tempdir());
        let (mission, folder) = (Mission::new(), folder.unwrap());
        Self { mission, folder, fresh: HashMap::new(), steps: HashMap::new() }
    }

    pub(super) fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    pub(super) fn scratch(&self, name: &str) -> PathBuf {
        let path = self.path(name);
        let _ = std::fs::remove_dir_all(&path);
        path
    }

    pub(super) fn open(&self, folder: &Path, every: u64) -> Ground {
        // A process that another test is starting has the descriptors of this one, and so its locks, until it runs its own program.
        for _ in 0..500 {
            match Ground::open(folder, &self.mission.config, every) {
                Err(GroundError::Locked { .. }) => std::thread::sleep(std::time::Duration::from_millis(20)),
                opened => return opened.unwrap(),
            }
        }
        Ground::open(folder, &self.mission.config, every).unwrap()
    }

    /// A checkpoint after a session without data.
    pub(super) fn settled(&self, checkpoint: &Path) -> Digest {
        let folder = self.scratch("settled");
        std::fs::create_dir(&folder).unwrap();
        std::fs::copy(checkpoint, folder.join(checkpoint.file_name().unwrap())).unwrap();
        self.open(&folder, u64::MAX).finish(&mut Outlet::collect()).unwrap();
        digest(checkpoints(&folder).last().unwrap())
    }

    pub(super) fn fresh(&mut self, packets: Packets) -> Digest {
        if let Some(&known) = self.fresh.get(&packets) {
            return known;
        }
        let folder = self.scratch("fresh");
        let order: Vec<usize> = (0..64).filter(|k| packets >> k & 1 == 1).collect();
        let mut ground = self.open(&folder, u64::MAX);
        ground.step(self.mission.bytes(&order), &mut Outlet::collect()).unwrap();
        ground.finish(&mut Outlet::collect()).unwrap();
        let found = digest(checkpoints(&folder).last().unwrap());
        self.fresh.insert(packets, found);
        found
    }
}
