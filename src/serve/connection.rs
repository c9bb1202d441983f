//! Connections: how many, how large, how slow.

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

/// Open connections. A browser keeps one for events, and a few for maps.
const CONNECTIONS_MAX: usize = 128;

/// Longest wait for the header of a request, also between two requests on one connection.
const HEADER_TIME: Duration = Duration::from_secs(10);

/// Longest time in which a reader takes nothing at all.
const STALL_TIME: Duration = Duration::from_secs(10);

/// Largest header of a request, and the buffer of an answer, bytes.
const BUFFER_BYTES: usize = 16 << 10;

/// Most header fields of a request.
const HEADERS_MAX: usize = 64;

/// Wait after a connection could not be accepted, for example because too many files are open.
const ACCEPT_WAIT: Duration = Duration::from_millis(50);

/// Answer to visitors when all places are taken.
const FULL: &[u8] = b"HTTP/1.1 503 Service Unavailable\r\nConnection: close\r\nContent-Length: 21\r\n\r\ntoo many connections\n";

/// Accepts connections until `stop`.
pub(super) async fn accept(
    listener: StdListener,
    router: Router,
    console: Arc<Console>,
    mut stop: watch::Receiver<bool>,
) -> io::Result<()> {
    let listener = TcpListener::from_std(listener)?;
    let places = Arc::new(Semaphore::new(CONNECTIONS_MAX));
    loop {
        let accepted = tokio::select! {
            _ = stop.changed() => return Ok(()),
            accepted = listener.accept() => accepted,
        };
        let Ok((stream, _)) = accepted else {
            sleep(ACCEPT_WAIT).await;
            continue;
        };
        let Ok(place) = Arc::clone(&places).try_acquire_owned() else {
            console.visitors.refused.fetch_add(1, Ordering::Relaxed);
            // Nobody waits for them to read it.
            let _ = stream.try_write(FULL);
            continue;
        };
        let (router, console) = (router.clone(), Arc::clone(&console));
        tokio::spawn(async move {
            let _place = place;
            console.visitors.open.fetch_add(1, Ordering::Relaxed);
            let served = http1::Builder::new()
                .timer(TokioTimer::new())
                .header_read_timeout(HEADER_TIME)
                .max_headers(HEADERS_MAX)
                .max_buf_size(BUFFER_BYTES)
                .serve_connection(TokioIo::new(PatientStream::new(stream)), TowerToHyperService::new(router))
                .await;
            // A reader that goes away is none of these.
            if served.is_err_and(|error| error.is_parse() || error.is_timeout() || is_stalled(&error)) {
                console.visitors.cut.fetch_add(1, Ordering::Relaxed);
            }
            console.visitors.open.fetch_sub(1, Ordering::Relaxed);
        });
    }
}

fn is_stalled(error: &hyper::Error) -> bool {
    let source = std::error::Error::source(error).and_then(|source| source.downcast_ref::<io::Error>());
    source.is_some_and(|source| source.kind() == io::ErrorKind::TimedOut)
}

/// A stream whose writes fail if its reader takes nothing for [`STALL_TIME`].
struct PatientStream {
    stream: TcpStream,
    /// Runs while a write waits.
    patience: Option<Pin<Box<Sleep>>>,
}

impl PatientStream {
    fn new(stream: TcpStream) -> Self {
        Self { stream, patience: None }
    }

    fn judge<T>(&mut self, context: &mut Context<'_>, result: Poll<io::Result<T>>) -> Poll<io::Result<T>> {
        if result.is_ready() {
            self.patience = None;
            return result;
        }
        let patience = self.patience.get_or_insert_with(|| Box::pin(sleep(STALL_TIME)));
        match patience.as_mut().poll(context) {
            Poll::Ready(()) => Poll::Ready(Err(io::ErrorKind::TimedOut.into())),
            Poll::Pending => Poll::Pending,
        }
    }
}

impl AsyncRead for PatientStream {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(context, buffer)
    }
}

impl AsyncWrite for PatientStream {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let result = Pin::new(&mut self.stream).poll_write(context, bytes);
        self.judge(context, result)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        parts: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let result = Pin::new(&mut self.stream).poll_write_vectored(context, parts);
        self.judge(context, result)
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
