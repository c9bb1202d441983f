//! The listening thread: accepts connections until its end condition holds.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use tokio::net::{TcpListener, TcpStream, UdpSocket};
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep, timeout};

use super::connection::serve;
use super::datagrams::receive;
use super::listener::{First, ListenContext, first};
use super::report::ListenEvent;
use super::seats::Room;

/// Interval between two checks of the end condition.
const TICK: Duration = Duration::from_millis(50);

/// Listens until the end condition holds, then waits for all connections to end.
///
/// Without a listener only datagrams come.
pub(super) async fn listen(
    (listener, datagrams): (Option<TcpListener>, Option<UdpSocket>),
    shared: Arc<ListenContext>,
) {
    let datagrams = datagrams.map(|socket| tokio::spawn(receive(socket, Arc::clone(&shared))));
    let mut connections = JoinSet::new();
    // Accepted, and without a place yet. Others wait in the system's queue, in the order in which they came.
    let mut newcomer: Option<(TcpStream, SocketAddr)> = None;
    shared.note_sign();
    while !shared.is_over() {
        while connections.try_join_next().is_some() {}
        if let Some((stream, peer)) = newcomer.take() {
            if connections.len() < shared.config.connections_max {
                connections.spawn(serve(stream, peer, Arc::clone(&shared)));
                continue;
            }
            match shared.seats.make_room(peer.ip(), Instant::now()) {
                Room::None => shared.refuse(&stream, peer),
                Room::Soon => {
                    newcomer = Some((stream, peer));
                    match first(shared.stopped(), timeout(TICK, connections.join_next())).await {
                        First::A(()) => break,
                        First::B(_) => {}
                    }
                }
            }
            continue;
        }
        let accepted = async {
            match &listener {
                Some(listener) => listener.accept().await,
                None => std::future::pending().await,
            }
        };
        match first(shared.stopped(), timeout(TICK, accepted)).await {
            First::A(()) => break,
            First::B(Err(_)) => {}
            First::B(Ok(Ok(accepted))) => newcomer = Some(accepted),
            // Too many open files, or the peer is gone already: others may connect.
            First::B(Ok(Err(error))) => {
                shared.notes.say(ListenEvent::AcceptFailed { reason: error.to_string() });
                sleep(TICK).await;
            }
        }
    }
    drop((listener, newcomer));
    shared.stop.send_replace(true);
    while connections.join_next().await.is_some() {}
    if let Some(datagrams) = datagrams {
        let _ = datagrams.await;
    }
}
