//! What is answered to which request.

use std::convert::Infallible;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use axum::Router;
use axum::body::Bytes;
use axum::extract::{Path, Request, State};
use axum::http::header::{
    ALLOW, CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, HOST, HeaderName, REFERRER_POLICY,
    X_CONTENT_TYPE_OPTIONS, X_FRAME_OPTIONS,
};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, Uri};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use futures_util::stream::{Stream, unfold};
use serde::Serialize;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};

use super::address::is_own_host;
use super::collector;
use super::console::Console;
use super::shelf::{MapChoice, ShownMap};
use super::status::Phase;
use crate::downlink::transport::socket::Listening;
use crate::ground::archive::CoverageSurvey;
use crate::sky::{Frame, Rotation};
use crate::units::ChannelId;
use crate::units::time_scales::leap_seconds;

/// The page may load what this server has, and nothing else from anywhere.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; \
    img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// Colours of a palette.
const PALETTE_STEPS: u32 = 256;

/// What all request handlers share.
#[derive(Clone)]
pub(super) struct PageState {
    pub(super) console: Arc<Console>,
    /// The newest status in JSON; empty before the first.
    pub(super) news: watch::Receiver<Arc<str>>,
    /// Where the server listens.
    pub(super) own: SocketAddr,
    /// Whether it may be called by any name.
    pub(super) any_host: bool,
    /// One slow answer is made at a time: the sums need the processors.
    pub(super) slow: Arc<Semaphore>,
    /// Places of those who read events: fewer than all connections, so that health, metrics and status are answered.
    pub(super) readers: Arc<Semaphore>,
}

/// Most readers of `/events` at a time.
pub(super) const READERS_MAX: usize = 96;

/// All routes.
pub(super) fn router(desk: PageState) -> Router {
    Router::new()
        .route("/", get(|| asset("text/html; charset=utf-8", include_str!("page/index.html"))))
        .route("/page.css", get(|| asset("text/css; charset=utf-8", include_str!("page/page.css"))))
        .route("/page.js", get(|| asset("text/javascript; charset=utf-8", include_str!("page/page.js"))))
        .route("/sky.js", get(|| asset("text/javascript; charset=utf-8", include_str!("page/sky.js"))))
        .route("/array.js", get(|| asset("text/javascript; charset=utf-8", include_str!("page/array.js"))))
        .route("/passes.js", get(|| asset("text/javascript; charset=utf-8", include_str!("page/passes.js"))))
        .route("/tools.js", get(|| asset("text/javascript; charset=utf-8", include_str!("page/tools.js"))))
        .route("/page.json", get(page_constants))
        .route("/favicon.svg", get(|| asset("image/svg+xml", include_str!("page/favicon.svg"))))
        .route("/events", get(events))
        .route("/api/status", get(status))
        .route("/api/config", get(config))
        .route("/api/figures/{channel}", get(figures))
        .route("/api/maps/{channel}/{file}", get(map))
        .route("/api/passes", get(passes))
        .route("/api/geometry", get(geometry))
        .route("/api/uvw/{channel}", get(uvw))
        .route("/api/hits/{channel}", get(hits))
        .route("/api/powers/{channel}", get(powers))
        .route("/api/gaps", get(gaps))
        .route("/metrics", get(metrics))
        .route("/healthz", get(healthz))
        .route("/readyz", get(readyz))
        .fallback(|| async {
            refusal(StatusCode::NOT_FOUND, "no such page; / has the page, /api/status the state")
        })
        .layer(from_fn_with_state(desk.clone(), guard))
        .with_state(desk)
}

/// Refuses what is not meant for this server, and adds the headers that every answer has.
async fn guard(State(desk): State<PageState>, request: Request, next: Next) -> Response {
    desk.console.visitors.requests.fetch_add(1, Ordering::Relaxed);
    let mut response = match refused(&desk, request.method(), request.uri(), request.headers()) {
        Some(refusal) => refusal,
        None => next.run(request).await,
    };
    let headers = response.headers_mut();
    for (name, value) in [
        (CONTENT_SECURITY_POLICY, POLICY),
        (X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (X_FRAME_OPTIONS, "DENY"),
        (REFERRER_POLICY, "no-referrer"),
        (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
        (HeaderName::from_static("cross-origin-opener-policy"), "same-origin"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    headers.entry(CACHE_CONTROL).or_insert(HeaderValue::from_static("no-store"));
    response
}

fn refused(desk: &PageState, method: &Method, uri: &Uri, headers: &HeaderMap) -> Option<Response> {
    if method != Method::GET && method != Method::HEAD {
        let mut response = refusal(StatusCode::METHOD_NOT_ALLOWED, "this server only tells; expected GET");
        response.headers_mut().insert(ALLOW, HeaderValue::from_static("GET, HEAD"));
        return Some(response);
    }
    let mut hosts = headers.get_all(HOST).iter();
    let (host, more) = (hosts.next().and_then(|host| host.to_str().ok()), hosts.next());
    let named = [host, uri.authority().map(|authority| authority.as_str())];
    let (Some(_), None) = (host, more) else {
        return Some(refusal(StatusCode::BAD_REQUEST, "expected one Host header"));
    };
    if !desk.any_host && !named.into_iter().flatten().all(|host| is_own_host(host, desk.own)) {
        let text = "this server answers to its own address and to localhost alone, not to the name in Host";
        return Some(refusal(StatusCode::MISDIRECTED_REQUEST, text));
    }
    None
}

fn refusal(status: StatusCode, text: &str) -> Response {
    (status, [(CONTENT_TYPE, "text/plain; charset=utf-8")], format!("{text}\n")).into_response()
}

fn answer(kind: &'static str, body: impl Into<Bytes>) -> Response {
    ([(CONTENT_TYPE, kind)], body.into()).into_response()
}

fn json(value: &impl Serialize) -> Response {
    match serde_json::to_vec(value) {
        Ok(text) => answer("application/json", text),
        Err(error) => refusal(StatusCode::INTERNAL_SERVER_ERROR, &error.to_string()),
    }
}

async fn asset(kind: &'static str, text: &'static str) -> Response {
    answer(kind, text)
}

/// Palettes as hexadecimal digits, and rotations from ecliptic axes: the page computes with the program's own numbers.
async fn page_constants() -> Response {
    #[derive(Serialize)]
    struct Constants {
        version: &'static str,
        palettes: [(&'static str, String); 4],
        /// Row k is the frame's axis k on ecliptic axes.
        frames: [(&'static str, Rotation); 3],
        /// From when on (TAI since 1970-01-01, s) UTC is how many seconds behind.
        leap_seconds: Vec<[i64; 2]>,
    }
    let colours = |gradient: colorous::Gradient, place: fn(f64) -> f64| {
        let colour = |k| gradient.eval_continuous(place(f64::from(k) / f64::from(PALETTE_STEPS - 1)));
        (0..PALETTE_STEPS).map(|k| format!("{:x}", colour(k))).collect()
    };
    let hex = |gradient| colours(gradient, |place| place);
    let frame = |frame: Frame| Frame::Ecliptic.to_frame(frame);
    json(&Constants {
        version: env!("CARGO_PKG_VERSION"),
        palettes: [
            ("inferno", hex(colorous::INFERNO)),
            ("cividis", hex(colorous::CIVIDIS)),
            ("viridis", hex(colorous::VIRIDIS)),
            ("difference", colours(colorous::RED_BLUE, |place| 1.0 - place)),
        ],
        frames: [
            ("galactic", frame(Frame::Galactic)),
            ("ecliptic", frame(Frame::Ecliptic)),
            ("equatorial", frame(Frame::Equatorial)),
        ],
        leap_seconds: leap_seconds().collect(),
    })
}

async fn status(State(desk): State<PageState>) -> Response {
    json(&desk.console.status())
}

async fn config(State(desk): State<PageState>) -> Response {
    answer("application/json", desk.console.config.clone())
}

/// Makes an answer that takes a while, away from the event loop and one at a time.
async fn slowly<T: Send + 'static>(
    desk: &PageState,
    make: impl FnOnce() -> T + Send + 'static,
) -> Result<T, Response> {
    let closed = |_| refusal(StatusCode::SERVICE_UNAVAILABLE, "the server is ending");
    let _turn = desk.slow.acquire().await.map_err(closed)?;
    let made = tokio::task::spawn_blocking(make).await;
    made.map_err(|_| {
        refusal(StatusCode::INTERNAL_SERVER_ERROR, "the answer could not be made: a bug in the program")
    })
}

fn channel_of(text: &str) -> Option<ChannelId> {
    let is_number =
        text.bytes().all(|digit| digit.is_ascii_digit()) && (text == "0" || !text.starts_with('0'));
    is_number.then(|| text.parse().ok().map(ChannelId))?
}

fn no_map() -> Response {
    refusal(
        StatusCode::NOT_FOUND,
        "no such map is held; expected /api/maps/CHANNEL/N.f32, .fits or .png with N a number that `held` of /api/status \
         names, latest, noise or input",
    )
}

fn no_channel() -> Response {
    refusal(StatusCode::NOT_FOUND, "no such channel; expected the number of one, from 0")
}

async fn figures(State(desk): State<PageState>, Path(channel): Path<String>) -> Response {
    let Some(channel) = channel_of(&channel) else { return no_map() };
    let shelf = Arc::clone(&desk.console.shelf);
    match slowly(&desk, move || shelf.figures(channel)).await {
        Ok(Some(figures)) => json(&figures),
        Ok(None) => no_map(),
        Err(refusal) => refusal,
    }
}

async fn map(State(desk): State<PageState>, Path((channel, file)): Path<(String, String)>) -> Response {
    let found = || {
        let (name, kind) = file.split_once('.')?;
        Some((desk.console.shelf.map(channel_of(&channel)?, MapChoice::read(name)?)?, kind))
    };
    let Some((map, kind)) = found() else { return no_map() };
    let make: fn(&ShownMap) -> Result<Option<Bytes>, String> = match kind {
        "f32" => return answer("application/octet-stream", map.pixels.clone()),
        "fits" => ShownMap::fits,
        "png" => |map| map.png().map(Some),
        _ => return no_map(),
    };
    let content = if kind == "fits" { "application/fits" } else { "image/png" };
    match slowly(&desk, move || make(&map)).await {
        Ok(Ok(Some(bytes))) => answer(content, bytes),
        Ok(Ok(None)) => refusal(StatusCode::NOT_FOUND, "noise and input are served as .f32 and .png"),
        Ok(Err(error)) => refusal(StatusCode::INTERNAL_SERVER_ERROR, &error),
        Err(refusal) => refusal,
    }
}

/// `null` before anything is known.
async fn passes(State(desk): State<PageState>) -> Response {
    json(&desk.console.passes().as_deref())
}

/// `null` before anything is known.
async fn geometry(State(desk): State<PageState>) -> Response {
    json(&desk.console.geometry())
}

/// `null` before anything is known.
async fn uvw(State(desk): State<PageState>, Path(channel): Path<String>) -> Response {
    channel_of(&channel).map_or_else(no_channel, |channel| json(&desk.console.uvw(channel)))
}

/// `null` before anything is known.
async fn hits(State(desk): State<PageState>, Path(channel): Path<String>) -> Response {
    let Some(channel) = channel_of(&channel) else { return no_channel() };
    let console = Arc::clone(&desk.console);
    match slowly(&desk, move || console.hits(channel)).await {
        Ok(hits) => json(&hits),
        Err(refusal) => refusal,
    }
}

/// `null` before anything is known.
async fn powers(State(desk): State<PageState>, Path(channel): Path<String>) -> Response {
    channel_of(&channel).map_or_else(no_channel, |channel| json(&desk.console.powers(channel)))
}

async fn gaps(State(desk): State<PageState>) -> Response {
    let Some(folder) = desk.console.state.clone() else {
        return refusal(StatusCode::NOT_FOUND, "gaps are known to a ground with a state: replay --state DIR");
    };
    match slowly(&desk, move || CoverageSurvey::read(&folder).map(|survey| survey.gaps())).await {
        Ok(Ok(gaps)) => json(&gaps),
        // No checkpoint yet.
        Ok(Err(error)) => refusal(StatusCode::SERVICE_UNAVAILABLE, &error.to_string()),
        Err(refusal) => refusal,
    }
}

async fn metrics(State(desk): State<PageState>) -> Response {
    match collector::scrape(&desk.console) {
        Ok(text) => {
            if desk.console.phase() == Phase::Failed {
                desk.console.failure_told.store(true, Ordering::Relaxed);
            }
            answer(collector::CONTENT_TYPE, text)
        }
        Err(error) => refusal(StatusCode::INTERNAL_SERVER_ERROR, &error.to_string()),
    }
}

async fn healthz(State(desk): State<PageState>) -> Response {
    match desk.console.phase() {
        Phase::Failed => refusal(StatusCode::SERVICE_UNAVAILABLE, "failed"),
        phase => answer("text/plain; charset=utf-8", format!("{}\n", phase.name())),
    }
}

async fn readyz(State(desk): State<PageState>) -> Response {
    let is_unwritten = |listening: &Listening| {
        listening.archive.as_ref().is_some_and(|archive| archive.report().unwritten.is_some())
    };
    let listening = desk.console.watched.get().and_then(|watched| watched.listening.as_ref());
    match desk.console.phase() {
        Phase::Running if listening.is_some_and(is_unwritten) => {
            refusal(StatusCode::SERVICE_UNAVAILABLE, "the raw archive cannot be written: nothing is taken")
        }
        Phase::Running => answer("text/plain; charset=utf-8", "running\n"),
        phase => refusal(StatusCode::SERVICE_UNAVAILABLE, phase.name()),
    }
}

/// State of one reader of events.
struct Reader {
    desk: PageState,
    seen: u64,
    queue: Vec<Event>,
    _place: OwnedSemaphorePermit,
}

async fn events(State(desk): State<PageState>) -> Response {
    match Arc::clone(&desk.readers).try_acquire_owned() {
        Ok(place) => events_for(desk, place).into_response(),
        Err(_) => {
            refusal(StatusCode::SERVICE_UNAVAILABLE, "too many readers of events; /api/status has the same")
        }
    }
}

fn events_for(
    desk: PageState,
    place: OwnedSemaphorePermit,
) -> Sse<impl Stream<Item = Result<Event, Infallible>>> {
    let mut reader = Reader { desk, seen: 0, queue: Vec::new(), _place: place };
    reader.desk.news.mark_changed();
    let next = |mut reader: Reader| async move {
        loop {
            if let Some(event) = reader.queue.pop() {
                return Some((Ok(event), reader));
            }
            // Whoever is late sees the newest status only.
            reader.desk.news.changed().await.ok()?;
            let status = Arc::clone(&reader.desk.news.borrow_and_update());
            if status.is_empty() {
                continue;
            }
            for entry in reader.desk.console.log.after(reader.seen) {
                reader.seen = entry.id;
                let text = serde_json::to_string(&entry).unwrap_or_default();
                reader.queue.push(Event::default().event("log").id(entry.id.to_string()).data(text));
            }
            reader.queue.push(Event::default().event("status").data(&*status));
            reader.queue.reverse();
        }
    };
    Sse::new(unfold(reader, next)).keep_alive(KeepAlive::default())
}
