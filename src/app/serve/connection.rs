//! HTTP connections, with limits on their number, size and time.

use std::io;
use std::net::TcpListener as StdListener;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::task::{Context, Poll};
use std::time::Duration;

use axum::Router;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{Semaphore, watch};
use tokio::time::{Sleep, sleep};

use super::console::Console;

/// Maximum number of open connections. A browser keeps one for events, and a few for maps.
const CONNECTIONS_MAX: usize = 128;

/// Time limit for the header of a request, also between two requests on one connection.
const HEADER_TIMEOUT: Duration = Duration::from_secs(10);

/// Time limit for a client that reads nothing.
const STALL_TIMEOUT: Duration = Duration::from_secs(10);

/// Maximum size of a request header, and size of the buffer of a response, bytes.
const BUFFER_BYTES: usize = 16 << 10;

/// Maximum number of header fields of a request.
const HEADERS_MAX: usize = 64;

/// Delay after a connection could not be accepted, for example because too many files are open.
const ACCEPT_DELAY: Duration = Duration::from_millis(50);

/// Response to a client above the limit of connections.
const FULL: &[u8] = b"HTTP/1.1 503 Service Unavailable\r\nConnection: close\r\nContent-Length: 21\r\n\r\ntoo many connections\n";

/// Accepts and serves connections until `stop` changes.
pub(super) async fn accept(
    listener: StdListener,
    router: Router,
    console: Arc<Console>,
    mut stop: watch::Receiver<bool>,
) -> io::Result<()> {
    let listener = TcpListener::from_std(listener)?;
    let permits = Arc::new(Semaphore::new(CONNECTIONS_MAX));
    loop {
        let accepted = tokio::select! {
            _ = stop.changed() => return Ok(()),
            accepted = listener.accept() => accepted,
        };
        let Ok((stream, _)) = accepted else {
            sleep(ACCEPT_DELAY).await;
            continue;
        };
        let Ok(permit) = Arc::clone(&permits).try_acquire_owned() else {
            console.clients.refused.fetch_add(1, Ordering::Relaxed);
            // The server does not wait until the client has read it.
            let _ = stream.try_write(FULL);
            continue;
        };
        let (router, console) = (router.clone(), Arc::clone(&console));
        tokio::spawn(async move {
            let _permit = permit;
            console.clients.open.fetch_add(1, Ordering::Relaxed);
            let served = http1::Builder::new()
                .timer(TokioTimer::new())
                .header_read_timeout(HEADER_TIMEOUT)
                .max_headers(HEADERS_MAX)
                .max_buf_size(BUFFER_BYTES)
                .serve_connection(TokioIo::new(TimeoutStream::new(stream)), TowerToHyperService::new(router))
                .await;
            // A client that closes its connection does not count.
            if served.is_err_and(|error| error.is_parse() || error.is_timeout() || is_stalled(&error)) {
                console.clients.cut.fetch_add(1, Ordering::Relaxed);
            }
            console.clients.open.fetch_sub(1, Ordering::Relaxed);
        });
    }
}

fn is_stalled(error: &hyper::Error) -> bool {
    let source = std::error::Error::source(error).and_then(|source| source.downcast_ref::<io::Error>());
    source.is_some_and(|source| source.kind() == io::ErrorKind::TimedOut)
}

/// A stream whose writes fail if its client reads nothing for [`STALL_TIMEOUT`].
struct TimeoutStream {
    stream: TcpStream,
    /// Timer of a write that waits.
    timer: Option<Pin<Box<Sleep>>>,
}

impl TimeoutStream {
    fn new(stream: TcpStream) -> Self {
        Self { stream, timer: None }
    }

    /// Turns a pending write into an error after the timeout.
    fn with_timeout<T>(
        &mut self,
        context: &mut Context<'_>,
        result: Poll<io::Result<T>>,
    ) -> Poll<io::Result<T>> {
        if result.is_ready() {
            self.timer = None;
            return result;
        }
        let timer = self.timer.get_or_insert_with(|| Box::pin(sleep(STALL_TIMEOUT)));
        match timer.as_mut().poll(context) {
            Poll::Ready(()) => Poll::Ready(Err(io::ErrorKind::TimedOut.into())),
            Poll::Pending => Poll::Pending,
        }
    }
}

impl AsyncRead for TimeoutStream {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(context, buffer)
    }
}

impl AsyncWrite for TimeoutStream {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let result = Pin::new(&mut self.stream).poll_write(context, bytes);
        self.with_timeout(context, result)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        parts: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let result = Pin::new(&mut self.stream).poll_write_vectored(context, parts);
        self.with_timeout(context, result)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}
