//! Senders that send what they should not, or too much.

use super::*;

/// Headers that claim the greatest packet, without one.
fn claims(count: u64) -> Vec<u8> {
    let header = |count| PacketHeader {
        kind: Kind::Visibilities,
        segment: PacketSegment::Whole,
        count: 2 * count,
        time: CucTime(1),
        version: FORMAT_VERSION,
        bytes: PACKET_BYTES_MAX,
    };
    (0..count).flat_map(|count| header(count).to_bytes()).collect()
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
    // Three give sound packets: the good one, the one that falls silent, the one of another mission.
    let ground = place.ground("heard", &[&set[..], &["--connections", "3"]].concat());
    // Until the ground closes; what it says then may be lost with the connection.
    let flood = |piece: &[u8]| {
        let mut stream = ground.connect();
        let mut bytes = 0_u64;
        while bytes < 1 << 30 && stream.write_all(piece).is_ok() {
            bytes += piece.len() as u64;
        }
        assert!(bytes < 1 << 30, "the ground goes on taking garbage");
    };
    let noise: Vec<u8> =
        (0..1_u64 << 16).map(|k| (k.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 41) as u8).collect();
    let marker = [0x1A, 0xCF, 0xFC, 0x1D];
    // Each looks like a frame's beginning; the second kind stands before blocks that are codewords.
    let markers: Vec<u8> = noise.chunks(3).flat_map(|noise| [&marker, noise].concat()).collect();
    let only_markers = marker.repeat(1 << 12);
    let foreign = transmit(&mission(1, 10), &DownlinkConfig::default());
    let packets = packets_of(&good);
    let over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let (ground, packets, foreign, over) = (&ground, &packets, &foreign, &over);
        // Sends all the while: some packets again, as long as the others are there.
        let good = scope.spawn(move || {
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
        });
        let answer_to = |bytes: &[u8]| {
            let mut stream = ground.connect();
            stream.write_all(bytes).unwrap();
            let mut answer = String::new();
            stream.read_to_string(&mut answer).unwrap();
            answer
        };
        let mut others = vec![
            scope.spawn(|| flood(&noise)),
            scope.spawn(|| flood(&markers)),
            scope.spawn(|| flood(&only_markers)),
            scope.spawn(|| flood(&claims(3000))),
            // A byte at a time, of sound packets.
            scope.spawn(|| {
                let mut stream = ground.connect();
                for octet in packets[0].iter().cycle() {
                    if stream.write_all(&[*octet]).is_err() {
                        break;
                    }
                    std::thread::sleep(Duration::from_millis(200));
                }
            }),
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
fn connections_beyond_the_limit_are_refused() {
    let place = Place::new();
    let file = place.downlink("packets");
    place.replay("read", &file, &[]);
    let good = std::fs::read(&file).unwrap();
    let (begin, rest) = good.split_at(good.len() / 3);
    let set = ["--set", "downlink.listen.connections_max=1", "--connections", "1"];
    let ground = place.ground("heard", &set);
    let mut stream = ground.connect();
    stream.write_all(begin).unwrap();
    // Whether the system hands over the second connection after the first is certain, when is not.
    let mut answer = String::new();
    ground.connect().read_to_string(&mut answer).unwrap();
    assert!(answer.contains("connections_max"), "{answer}");
    finish(stream, rest);
    let summary = ground.succeed();
    assert_eq!([&summary["listening"]["connections"], &summary["listening"]["refused"]], [1, 1]);
    assert!(place.maps("heard") == place.maps("read"));
}

#[test]
fn a_ground_that_is_slower_slows_the_sender_and_keeps_its_memory() {
    const OFFERED: usize = 200 << 20;
    let backlog = 1 << 20;
    let limits = ListenConfig { backlog_bytes_max: backlog, bytes_per_s_max: 0.0, ..ListenConfig::default() };
    let until = Until { connections: 1, ..Until::default() };
    let mut source = SocketSource::bind(&["127.0.0.1:0".parse().unwrap()], &limits, until).unwrap();
    let address = source.url().to_string();
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
    // One look starts the listener; then the ground takes its time.
    let mut taken = 0;
    let mut out = Outlet::collect();
    let mut take = |source: &mut SocketSource| {
        let flow = source.next(&mut out).unwrap();
        taken += out.take().iter().map(Vec::len).sum::<usize>();
        (flow, taken)
    };
    let (_, first) = take(&mut source);
    // Until nothing has moved for a while.
    let mut stood = 0;
    while stood < 10 || sent.load(Ordering::Relaxed) == 0 {
        let before = sent.load(Ordering::Relaxed);
        std::thread::sleep(Duration::from_millis(50));
        stood = if sent.load(Ordering::Relaxed) == before { stood + 1 } else { 0 };
    }
    // What is on the way: the backlog, what one connection has in hand, and what the system holds for a connection, 10
    // MiB at the most on Linux (tcp_wmem and tcp_rmem).
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
