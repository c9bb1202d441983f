//! Misbehaving senders: bad data, or too much.

use lunarray::downlink::wire::cadu::randomize;

use super::*;

/// Headers that announce the longest packet, without one.
fn claims(count: u64) -> Vec<u8> {
    let header = |count| PacketHeader {
        kind: PacketKind::Visibilities,
        segment: PacketSegment::Whole,
        count: 2 * count,
        time: CucTime(1),
        version: FORMAT_VERSION,
        bytes: PACKET_BYTES_MAX,
    };
    (0..count).flat_map(|count| header(count).to_bytes()).collect()
}

/// Sends a piece again and again until the ground closes; its answer may then be lost with the connection.
fn flood(ground: &Ground, piece: &[u8]) {
    let mut stream = ground.connect();
    let mut bytes = 0_u64;
    while bytes < 1 << 30 && stream.write_all(piece).is_ok() {
        bytes += piece.len() as u64;
    }
    assert!(bytes < 1 << 30, "the ground goes on taking garbage");
}

/// Sends sound packets a byte at a time.
fn trickle(ground: &Ground, packet: &[u8]) {
    let mut stream = ground.connect();
    for octet in packet.iter().cycle() {
        if stream.write_all(&[*octet]).is_err() {
            break;
        }
        std::thread::sleep(Duration::from_millis(200));
    }
}

/// Sends all packets, then the first again and again while others are connected.
fn send_until(over: &AtomicBool, ground: &Ground, packets: &[Vec<u8>]) {
    let (mut stream, mut sent) = (ground.connect(), 0);
    for packets in packets.chunks(packets.len() / 20 + 1) {
        for packet in packets {
            stream.write_all(packet).unwrap();
            sent += packet.len();
        }
        std::thread::sleep(Duration::from_millis(100));
    }
    while !over.load(Ordering::Relaxed) {
        stream.write_all(&packets[0]).unwrap();
        sent += packets[0].len();
        std::thread::sleep(Duration::from_millis(100));
    }
    assert_eq!(finish(stream, &[]), format!("taken {sent} bytes\n"));
}

#[test]
fn bad_senders_are_closed_and_counted_and_a_good_one_loses_nothing() {
    let place = Place::new();
    let file = place.downlink("packets");
    place.replay("read", &file, &[]);
    let good = std::fs::read(&file).unwrap();
    let set = ["first_packet_s_max=4", "idle_s_max=4", "garbage_bytes_max=65536", "memory_bytes_max=4194304"];
    let set = set.map(|limit| format!("downlink.listen.{limit}"));
    let set: Vec<&str> = set.iter().flat_map(|limit| ["--set", limit.as_str()]).collect();
    // Three deliver sound packets: the good one, the one that falls silent, the one of another mission.
    let ground = place.ground("heard", &[&set[..], &["--connections", "3"]].concat());
    let noise: Vec<u8> =
        (0..1_u64 << 16).map(|k| (k.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 41) as u8).collect();
    let marker = [0x1A, 0xCF, 0xFC, 0x1D];
    // Each looks like the beginning of a frame; the second kind precedes blocks that are codewords.
    let markers: Vec<u8> = noise.chunks(3).flat_map(|noise| [&marker, noise].concat()).collect();
    let only_markers = marker.repeat(1 << 12);
    let foreign = transmit(&mission(1, 10), &DownlinkConfig::default());
    let packets = packets_of(&good);
    let over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let (ground, packets, foreign, over) = (&ground, &packets, &foreign, &over);
        let good = scope.spawn(move || send_until(over, ground, packets));
        let answer_to = |bytes: &[u8]| {
            let mut stream = ground.connect();
            stream.write_all(bytes).unwrap();
            let mut answer = String::new();
            stream.read_to_string(&mut answer).unwrap();
            answer
        };
        let mut others = vec![
            scope.spawn(|| flood(ground, &noise)),
            scope.spawn(|| flood(ground, &markers)),
            scope.spawn(|| flood(ground, &only_markers)),
            scope.spawn(|| flood(ground, &claims(3000))),
            scope.spawn(|| trickle(ground, &packets[0])),
            scope.spawn(move || assert!(answer_to(&[]).contains("first_packet_s_max"))),
            scope.spawn(move || assert!(answer_to(&packets[0]).contains("idle_s_max"))),
            scope.spawn(|| assert_eq!(ground.send(&[]), "taken 0 bytes\n")),
        ];
        // Once the ground knows the instrument.
        std::thread::sleep(Duration::from_millis(500));
        others.push(scope.spawn(move || {
            let mut stream = ground.connect();
            let _ = stream.write_all(foreign);
            let _ = stream.read_to_end(&mut Vec::new());
        }));
        let ends: Vec<_> = others.into_iter().map(|other| other.join()).collect();
        over.store(true, Ordering::Relaxed);
        good.join().unwrap();
        assert!(ends.iter().all(Result::is_ok));
    });
    let memory = ground.memory();
    let (status, summary, said) = ground.end();
    assert!(status.success(), "{said}");
    assert!(place.maps("heard") == place.maps("read"));
    let ended = &summary["listening"]["ended"];
    let expected = [("whole", 2), ("garbage", 4), ("first-packet", 2), ("idle", 1), ("other-instrument", 1)];
    for (key, count) in expected {
        assert_eq!(ended[key], count, "{key} in {ended}\n{said}");
    }
    for limit in ["first_packet_s_max", "idle_s_max", "garbage_bytes_max", "another instrument"] {
        assert!(said.contains(limit), "{limit} is not in {said}");
    }
    assert_closed(&summary["reception"]);
    let garbage = summary["reception"]["bytes_garbage"].as_u64().unwrap();
    let damaged = summary["reception"]["bytes_damaged"].as_u64().unwrap();
    assert!(garbage > 2 << 16 && damaged > 0, "garbage {garbage}, damaged {damaged}");
    // Nine connections with 4 MiB each, a backlog of 8 MiB, queues of 64 pieces of 64 KiB; the rest of the program
    // takes some 30 MB. Far below what was offered.
    assert!(memory < 120 << 20, "{memory} bytes");
}

#[test]
fn beyond_the_limit_a_connection_that_delivers_stays() {
    let place = Place::new();
    let file = place.downlink("packets");
    place.replay("read", &file, &[]);
    let packets = packets_of(&std::fs::read(&file).unwrap());
    let set = ["--set", "downlink.listen.connections_max=1", "--connections", "1"];
    let ground = place.ground("heard", &set);
    let over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let (ground, over, packets) = (&ground, &over, &packets);
        let good = scope.spawn(move || {
            let mut stream = ground.connect();
            // Delivers as long as the other tries: in small pieces, of which there are enough for a minute.
            let (mut left, piece) = (&packets[..], packets.len().div_ceil(600));
            while !over.load(Ordering::Relaxed) && left.len() > piece {
                let (now, rest) = left.split_at(piece);
                stream.write_all(&now.concat()).unwrap();
                left = rest;
                std::thread::sleep(Duration::from_millis(100));
            }
            finish(stream, &left.concat())
        });
        // Whether the system hands over the second connection after the first is certain, when is not.
        ground.wait_for("listening on");
        std::thread::sleep(Duration::from_millis(300));
        let mut answer = String::new();
        ground.connect().read_to_string(&mut answer).unwrap();
        over.store(true, Ordering::Relaxed);
        assert!(answer.starts_with("busy: ") && answer.contains("connections_max"), "{answer}");
        assert!(good.join().unwrap().starts_with("taken "));
    });
    let summary = ground.succeed();
    assert_eq!([&summary["listening"]["connections"], &summary["listening"]["refused"]], [1, 1]);
    assert!(place.maps("heard") == place.maps("read"));
}

/// Keeps 24 peers at a ground that has places for a few: each connects, may send one packet, stays until it is closed,
/// and connects again. Meanwhile a good sender sends a downlink; returns the ground's summary.
fn besieged(place: &Place, name: &str, from: &[&str], replayed: &[Vec<u8>]) -> Value {
    let set = ["--set", "downlink.listen.connections_max=4", "--set", "downlink.listen.bytes_per_s_max=0"];
    // It is ended by a signal, and however busy the machine, the maps are made.
    let ground = place.ground(name, &[&set[..], &["--set", "runtime.grace_s=100000"]].concat());
    let over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let (ground, over) = (&ground, &over);
        for peer in 0..24 {
            let packet = replayed.get(peer % replayed.len().max(1)).cloned().unwrap_or_default();
            let address = from[peer % from.len()].to_owned();
            scope.spawn(move || {
                while !over.load(Ordering::Relaxed) {
                    let Some(mut stream) = connect_from(&address, &ground.url) else { continue };
                    let _ = stream.write_all(&packet);
                    stream.set_read_timeout(Some(Duration::from_millis(200))).unwrap();
                    let mut answer = [0; 256];
                    // Until the ground closes it.
                    while !over.load(Ordering::Relaxed)
                        && matches!(stream.read(&mut answer), Err(error) if is_time_out(&error))
                    {
                    }
                }
            });
        }
        // They hold all places.
        ground.wait_for("gave way");
        let said = succeed(&["simulate", place.pipeline(), "--send", &ground.url, "--connect-s", "600"]);
        over.store(true, Ordering::Relaxed);
        assert!(said.contains("confirmed all"), "{said}");
    });
    let killed = Process::new("kill").args(["-INT", &ground.child.id().to_string()]).status().unwrap();
    assert!(killed.success());
    let (_, summary, _) = ground.end();
    summary
}

fn is_time_out(error: &std::io::Error) -> bool {
    matches!(error.kind(), std::io::ErrorKind::WouldBlock | std::io::ErrorKind::TimedOut)
}

/// A connection from a loopback address.
fn connect_from(address: &str, url: &str) -> Option<TcpStream> {
    let (from, to) = (format!("{address}:0").parse().unwrap(), url.strip_prefix("tcp://").unwrap());
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().build().unwrap();
    let connected = runtime.block_on(async {
        let socket = tokio::net::TcpSocket::new_v4()?;
        socket.bind(from)?;
        socket.connect(to.parse().unwrap()).await?.into_std()
    });
    // The system may be short of ports for a moment.
    let stream = connected.ok()?;
    stream.set_nonblocking(false).unwrap();
    Some(stream)
}

#[test]
fn silent_peers_do_not_keep_a_good_sender_out() {
    let place = Place::new();
    let file = place.downlink("packets");
    place.replay("read", &file, &[]);
    // From one address, which the good sender has too; and from others.
    for (name, from) in [("one", &["127.0.0.1"][..]), ("others", &["127.0.0.2", "127.0.0.3"])] {
        let summary = besieged(&place, name, from, &[]);
        assert!(place.maps(name) == place.maps("read"), "{name}");
        assert!(summary["listening"]["ended"]["gave-way"].as_u64() > Some(3), "{}", summary["listening"]);
    }
}

#[test]
fn peers_that_replay_a_packet_each_do_not_keep_a_good_sender_out() {
    let place = Place::new();
    let file = place.downlink("packets");
    place.replay("read", &file, &[]);
    let packets = packets_of(&std::fs::read(&file).unwrap());
    let summary = besieged(&place, "heard", &["127.0.0.1"], &packets[packets.len() - 24..]);
    assert!(place.maps("heard") == place.maps("read"));
    assert!(summary["listening"]["ended"]["gave-way"].as_u64() > Some(3), "{}", summary["listening"]);
}

#[test]
fn the_first_description_shuts_nobody_out() {
    let place = Place::new();
    let file = place.downlink("packets");
    place.replay("read", &file, &[]);
    let good = std::fs::read(&file).unwrap();
    let other = transmit(&mission(1, 10), &DownlinkConfig::default());
    let others = packets_of(&other);
    let is_data = |packet: &&Vec<u8>| PacketHeader::parse(packet).unwrap().kind == PacketKind::Visibilities;
    let without_data: Vec<u8> = others.iter().filter(|packet| !is_data(packet)).flatten().copied().collect();
    let ground = place.ground("heard", &["--state", &place.path("state"), "--connections", "3"]);
    for bytes in [&others[0], &without_data] {
        let answer = ground.send(bytes);
        assert!(answer.contains("confirmed its instrument"), "{answer}");
    }
    assert_eq!(ground.send(&good), format!("taken {} bytes\n", good.len()));
    let summary = ground.succeed();
    assert_eq!(summary["listening"]["ended"]["unconfirmed"], 2);
    assert!(place.maps("heard") == place.maps("read"));
}

#[test]
fn an_instrument_of_too_many_channels_takes_no_memory() {
    let place = Place::new();
    let file = place.downlink("packets");
    place.replay("read", &file, &[]);
    let good = std::fs::read(&file).unwrap();
    // 400 channels with one visibility each.
    let mut frames = mission(1, 1);
    let lunarray::frames::GroundFrame::Instrument(instrument) = &mut frames[0] else {
        panic!("no description")
    };
    instrument.channels = vec![instrument.channels[0]; 400];
    let lunarray::frames::GroundFrame::Visibilities(block) = frames[2].clone() else { panic!("no data") };
    frames.truncate(2);
    frames.extend((0..400).map(|channel| {
        let channel = lunarray::units::ChannelId(channel);
        lunarray::frames::GroundFrame::Visibilities(lunarray::frames::VisibilityBlock {
            channel,
            ..block.clone()
        })
    }));
    let forged = transmit(&frames, &DownlinkConfig::default());
    let ground = place.ground("heard", &["--connections", "2"]);
    let answer = ground.send(&forged);
    assert!(answer.contains("does not fit the ground's configuration"), "{answer}");
    ground.send(&good);
    let summary = ground.succeed();
    assert_eq!(summary["listening"]["ended"]["unfit-instrument"], 1);
    assert!(place.maps("heard") == place.maps("read"));
    // From a file it is an error that names the key.
    let file = place.path("forged");
    std::fs::write(&file, forged).unwrap();
    let said = complaint(&["replay", &file, "--out", &place.path("out")]);
    assert!(said.contains("map.channels_max = 64") && said.contains("400 channels"), "{said}");
}

#[test]
fn a_ground_that_is_slower_slows_the_sender_and_keeps_its_memory() {
    const OFFERED: usize = 200 << 20;
    let backlog = 1 << 20;
    let limits = ListenConfig { backlog_bytes_max: backlog, bytes_per_s_max: 0.0, ..ListenConfig::default() };
    let until = ListenLimits { connections: 1, ..ListenLimits::default() };
    let mut source = SocketSource::bind(&["127.0.0.1:0".parse().unwrap()], &limits, until).unwrap();
    let address = source.addresses()[0].clone();
    let address = address.strip_prefix("tcp://").unwrap().to_owned();
    let bytes = transmit(&mission(20, 2000), &DownlinkConfig::default());
    let length = bytes.len();
    let times = OFFERED / length;
    let sent = Arc::new(AtomicUsize::new(0));
    let count = Arc::clone(&sent);
    let sender = std::thread::spawn(move || {
        let mut stream = TcpStream::connect(address).unwrap();
        for _ in 0..times {
            for piece in bytes.chunks(1 << 16) {
                stream.write_all(piece).unwrap();
                count.fetch_add(piece.len(), Ordering::Relaxed);
            }
        }
        finish(stream, &[])
    });
    // One call starts the listener; then the ground stalls.
    let mut taken = 0;
    let mut out = Outlet::collect();
    let mut take = |source: &mut SocketSource| {
        let flow = source.next(&mut out).unwrap();
        taken += out.take().iter().map(Vec::len).sum::<usize>();
        (flow, taken)
    };
    let (_, first) = take(&mut source);
    // Until nothing has changed for a while.
    let mut stood = 0;
    while stood < 10 || sent.load(Ordering::Relaxed) == 0 {
        let before = sent.load(Ordering::Relaxed);
        std::thread::sleep(Duration::from_millis(50));
        stood = if sent.load(Ordering::Relaxed) == before { stood + 1 } else { 0 };
    }
    // In transit: the backlog, one connection's buffers, and the system's buffers for a connection, at most 10 MiB on
    // Linux (tcp_wmem and tcp_rmem).
    let on_the_way = sent.load(Ordering::Relaxed) - first;
    assert!(on_the_way < (backlog as usize) + (2 << 20) + (32 << 20), "{on_the_way} bytes");
    assert!(source.listening().status.backlog_bytes() <= backlog);
    let all = loop {
        match take(&mut source) {
            (Flow::Continue, _) => {}
            (Flow::Done, all) => break all,
        }
    };
    source.finish(&mut Outlet::collect()).unwrap();
    assert_eq!(all, times * length);
    assert_eq!(sender.join().unwrap(), format!("taken {all} bytes\n"));
    assert!(source.listening().report().backlog_bytes_max <= backlog);
}

#[test]
fn what_is_no_downlink_is_not_taken() {
    let place = Place::new();
    let file = place.downlink("packets");
    let good = std::fs::read(&file).unwrap();
    let mut packed = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    packed.write_all(&good).unwrap();
    let packed = packed.finish().unwrap();
    // Frames without sync marker, randomizer and parity, as some stations store them: 5 blocks of 255 octets, 223 of them data.
    let coded = std::fs::read(place.downlink("cadu")).unwrap();
    let frame = |cadu: &[u8]| {
        let mut block = cadu[4..].to_vec();
        randomize(&mut block);
        block.truncate(5 * 223);
        block
    };
    let bare: Vec<u8> = coded.chunks_exact(4 + 5 * 255).flat_map(frame).collect();
    let state = place.path("state");
    let ground = place.ground("heard", &["--state", &state, "--connections", "2"]);
    // So that the ground has an instrument.
    assert_eq!(ground.send(&good), format!("taken {} bytes\n", good.len()));
    for (bytes, found) in [
        (&packed[..], "a gzip file: expand it first (gunzip)"),
        (b"a line of text\n", "a text file"),
        (b"SIMPLE  =                    T / a header\n", "a FITS file"),
        (&[0; 300], "no valid packet"),
        (&bare, "AOS transfer frames"),
    ] {
        let answer = ground.send(bytes);
        assert!(answer.starts_with(&format!("closed after {} bytes: ", bytes.len())), "{answer}");
        assert!(answer.contains(found), "{answer}");
    }
    ground.send(&good);
    let summary = ground.succeed();
    assert_eq!(summary["listening"]["ended"]["not-a-downlink"], 5);
    assert_eq!(summary["listening"]["ended"]["whole"], 2);
}
