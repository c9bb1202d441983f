//! The listening thread: accepts connections until its end condition holds.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use tokio::net::{TcpListener, TcpStream, UdpSocket};
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep, timeout};

use super::connection::serve;
use super::datagrams::receive;
use super::listener::{ListenContext, Race, race};
use super::report::ListenEvent;
use super::slots::Vacancy;

/// Interval between two checks of the end condition.
const TICK: Duration = Duration::from_millis(50);

/// Listens until the end condition holds, then waits for all connections to end. Without a listener it only receives
/// datagrams.
pub(super) async fn listen(
    (listener, datagrams): (Option<TcpListener>, Option<UdpSocket>),
    shared: Arc<ListenContext>,
) {
    let datagrams = datagrams.map(|socket| tokio::spawn(receive(socket, Arc::clone(&shared))));
    let mut connections = JoinSet::new();
    // An accepted connection that waits for a slot. Others wait in the system's queue, in the order of arrival.
    let mut waiting: Option<(TcpStream, SocketAddr)> = None;
    shared.record_activity();
    while !shared.is_over() {
        while connections.try_join_next().is_some() {}
        if let Some((stream, peer)) = waiting.take() {
            if connections.len() < shared.config.connections_max {
                connections.spawn(serve(stream, peer, Arc::clone(&shared)));
                continue;
            }
            match shared.slots.request_eviction(peer.ip(), Instant::now()) {
                Vacancy::Unavailable => shared.refuse(&stream, peer),
                Vacancy::Expected => {
                    waiting = Some((stream, peer));
                    match race(shared.stopped(), timeout(TICK, connections.join_next())).await {
                        Race::A(()) => break,
                        Race::B(_) => {}
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
        match race(shared.stopped(), timeout(TICK, accepted)).await {
            Race::A(()) => break,
            Race::B(Err(_)) => {}
            Race::B(Ok(Ok(accepted))) => waiting = Some(accepted),
            // Too many open files, or the peer has gone: others may connect.
            Race::B(Ok(Err(error))) => {
                shared.notes.report(ListenEvent::AcceptFailed { reason: error.to_string() });
                sleep(TICK).await;
            }
        }
    }
    drop((listener, waiting));
    shared.stop.send_replace(true);
    while connections.join_next().await.is_some() {}
    if let Some(datagrams) = datagrams {
        let _ = datagrams.await;
    }
}
