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
use super::routes::{PageState, router, vital_router};

/// Maximum number of open connections. A browser keeps one for events, and a few for maps.
const CONNECTIONS_MAX: usize = 128;

/// Time limit for the header of a request, also between two requests on one connection.
const HEADER_TIMEOUT: Duration = Duration::from_secs(10);

/// Places beyond [`CONNECTIONS_MAX`] for one request each of health, metrics or status, which no reader can take for long.
const VITAL_MAX: usize = 16;

/// Time limit for the header of a request in such a place.
const VITAL_HEADER_TIMEOUT: Duration = Duration::from_secs(1);

/// Time limit for a client that reads nothing.
const STALL_TIMEOUT: Duration = Duration::from_secs(10);

/// Maximum size of a request header, and size of the buffer of a response, bytes.
const BUFFER_BYTES: usize = 16 << 10;

/// Maximum number of header fields of a request.
const HEADERS_MAX: usize = 64;

/// Delay after a connection could not be accepted, for example because too many files are open.
const ACCEPT_DELAY: Duration = Duration::from_millis(50);

/// Response to a client beyond all places.
const FULL: &[u8] = b"HTTP/1.1 503 Service Unavailable\r\nConnection: close\r\nContent-Length: 21\r\n\r\ntoo many connections\n";

/// How connections are served.
#[derive(Clone)]
struct Service {
    router: Router,
    places: Arc<Semaphore>,
    header_timeout: Duration,
    /// Whether a connection may have more than one request.
    keep_alive: bool,
}

/// Accepts and serves connections until `stop` changes.
pub(super) async fn accept(
    listener: StdListener,
    page: PageState,
    mut stop: watch::Receiver<bool>,
) -> io::Result<()> {
    let listener = TcpListener::from_std(listener)?;
    let console = Arc::clone(&page.console);
    let service = |router, places, header_timeout, keep_alive| {
        let places = Arc::new(Semaphore::new(places));
        Service { router, places, header_timeout, keep_alive }
    };
    let services = [
        service(router(page.clone()), CONNECTIONS_MAX, HEADER_TIMEOUT, true),
        service(vital_router(page), VITAL_MAX, VITAL_HEADER_TIMEOUT, false),
    ];
    loop {
        let accepted = tokio::select! {
            _ = stop.changed() => return Ok(()),
            accepted = listener.accept() => accepted,
        };
        let Ok((stream, _)) = accepted else {
            sleep(ACCEPT_DELAY).await;
            continue;
        };
        let place = services.iter().find_map(|service| {
            let permit = Arc::clone(&service.places).try_acquire_owned().ok()?;
            Some((service.clone(), permit))
        });
        let Some((service, permit)) = place else {
            console.clients.refused.fetch_add(1, Ordering::Relaxed);
            // The server does not wait until the client has read it.
            let _ = stream.try_write(FULL);
            continue;
        };
        let console = Arc::clone(&console);
        tokio::spawn(async move {
            let _permit = permit;
            console.clients.open.fetch_add(1, Ordering::Relaxed);
            service.serve(stream, &console).await;
            console.clients.open.fetch_sub(1, Ordering::Relaxed);
        });
    }
}

impl Service {
    async fn serve(self, stream: TcpStream, console: &Console) {
        let served = http1::Builder::new()
            .timer(TokioTimer::new())
            .header_read_timeout(self.header_timeout)
            .keep_alive(self.keep_alive)
            .max_headers(HEADERS_MAX)
            .max_buf_size(BUFFER_BYTES)
            .serve_connection(TokioIo::new(TimeoutStream::new(stream)), TowerToHyperService::new(self.router))
            .await;
        // A client that closes its connection does not count.
        if served.is_err_and(|error| error.is_parse() || error.is_timeout() || is_stalled(&error)) {
            console.clients.cut.fetch_add(1, Ordering::Relaxed);
        }
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
