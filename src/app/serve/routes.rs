//! Routes and their handlers.

use std::convert::Infallible;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use axum::Router;
use axum::body::Bytes;
use axum::extract::{Path, Request, State};
use axum::http::header::{
    ALLOW, CACHE_CONTROL, CONNECTION, CONTENT_SECURITY_POLICY, CONTENT_TYPE, HOST, HeaderName,
    REFERRER_POLICY, X_CONTENT_TYPE_OPTIONS, X_FRAME_OPTIONS,
};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, Uri};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use futures_util::stream::{Stream, unfold};
use serde::Serialize;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};

use super::address::is_loopback_host;
use super::console::Console;
use super::map_cache::{MapChoice, ShownMap};
use super::prometheus;
use super::status::Phase;
use crate::downlink::transport::socket::Listening;
use crate::ground::archive::CoverageSurvey;
use crate::sky::{Frame, Rotation};
use crate::units::ChannelId;
use crate::units::time_scales::leap_seconds;

/// Content security policy: the page may load resources from this server only.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; \
    img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

const PALETTE_STEPS: u32 = 256;

/// State that all request handlers share.
#[derive(Clone)]
pub(super) struct PageState {
    /// What the run shows: maps, log, phase, clients.
    pub(super) console: Arc<Console>,
    /// The newest status in JSON; empty before the first.
    pub(super) newest_status: watch::Receiver<Arc<str>>,
    /// Address on which the server listens.
    pub(super) address: SocketAddr,
    /// Whether any `Host` header is accepted.
    pub(super) any_host: bool,
    /// Permit for slow responses: one at a time, as the run needs the processors.
    pub(super) slow: Arc<Semaphore>,
    /// Permits for readers of events: fewer than connections, so that health, metrics and status always respond.
    pub(super) readers: Arc<Semaphore>,
}

pub(super) const READERS_MAX: usize = 96;

/// The routes that answer also when all connections are taken.
fn vital_routes() -> Router<PageState> {
    Router::new()
        .route("/api/status", get(status))
        .route("/metrics", get(metrics))
        .route("/healthz", get(healthz))
        .route("/readyz", get(readyz))
}

/// Beyond the limit of connections: answers the vital routes, and refuses all others.
pub(super) fn vital_router(page: PageState) -> Router {
    vital_routes()
        .fallback(|State(page): State<PageState>| async move {
            page.console.clients.refused.fetch_add(1, Ordering::Relaxed);
            refusal(StatusCode::SERVICE_UNAVAILABLE, "too many connections")
        })
        .layer(from_fn_with_state(page.clone(), guard))
        .with_state(page)
}

pub(super) fn router(page: PageState) -> Router {
    vital_routes()
        .route("/", get(|| asset("text/html; charset=utf-8", include_str!("page/index.html"))))
        .route("/page.css", get(|| asset("text/css; charset=utf-8", include_str!("page/page.css"))))
        .route("/page.js", get(|| asset("text/javascript; charset=utf-8", include_str!("page/page.js"))))
        .route("/sky.js", get(|| asset("text/javascript; charset=utf-8", include_str!("page/sky.js"))))
        .route("/array.js", get(|| asset("text/javascript; charset=utf-8", include_str!("page/array.js"))))
        .route("/passes.js", get(|| asset("text/javascript; charset=utf-8", include_str!("page/passes.js"))))
        .route("/vitals.js", get(|| asset("text/javascript; charset=utf-8", include_str!("page/vitals.js"))))
        .route("/tools.js", get(|| asset("text/javascript; charset=utf-8", include_str!("page/tools.js"))))
        .route("/page.json", get(page_constants))
        .route("/favicon.svg", get(|| asset("image/svg+xml", include_str!("page/favicon.svg"))))
        .route("/events", get(events))
        .route("/api/config", get(config))
        .route("/api/figures/{channel}", get(figures))
        .route("/api/maps/{channel}/{file}", get(map))
        .route("/api/passes", get(passes))
        .route("/api/geometry", get(geometry))
        .route("/api/uvw/{channel}", get(uvw))
        .route("/api/hits/{channel}", get(hits))
        .route("/api/powers/{channel}", get(powers))
        .route("/api/gaps", get(gaps))
        .fallback(|| async {
            refusal(StatusCode::NOT_FOUND, "no such page; / has the page, /api/status the state")
        })
        .layer(from_fn_with_state(page.clone(), guard))
        .with_state(page)
}

/// Refuses requests with another method or host, and adds the headers of every response.
async fn guard(State(page): State<PageState>, request: Request, next: Next) -> Response {
    page.console.clients.requests.fetch_add(1, Ordering::Relaxed);
    let mut response = match refused(&page, request.method(), request.uri(), request.headers()) {
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

fn refused(page: &PageState, method: &Method, uri: &Uri, headers: &HeaderMap) -> Option<Response> {
    if method != Method::GET && method != Method::HEAD {
        let mut response =
            refusal(StatusCode::METHOD_NOT_ALLOWED, "this server is read-only; expected GET or HEAD");
        response.headers_mut().insert(ALLOW, HeaderValue::from_static("GET, HEAD"));
        return Some(response);
    }
    let mut hosts = headers.get_all(HOST).iter();
    let (host, second_host) = (hosts.next().and_then(|host| host.to_str().ok()), hosts.next());
    let named_hosts = [host, uri.authority().map(|authority| authority.as_str())];
    let (Some(_), None) = (host, second_host) else {
        return Some(refusal(StatusCode::BAD_REQUEST, "expected one Host header"));
    };
    if !page.any_host && !named_hosts.into_iter().flatten().all(|host| is_loopback_host(host, page.address)) {
        let text = "the Host header names another server; expected localhost or the address of this server";
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

/// Constants of the program that the page needs: palettes as hexadecimal digits, rotations from ecliptic axes, leap seconds.
async fn page_constants() -> Response {
    #[derive(Serialize)]
    struct Constants {
        version: &'static str,
        palettes: [(&'static str, String); 4],
        /// Rotations; row k is the frame's axis k in ecliptic axes.
        frames: [(&'static str, Rotation); 3],
        /// Start of each interval (TAI since 1970-01-01, s), and TAI minus UTC in it, s.
        leap_seconds: Vec<[i64; 2]>,
    }
    let colours = |gradient: colorous::Gradient, position: fn(f64) -> f64| {
        let colour = |k| gradient.eval_continuous(position(f64::from(k) / f64::from(PALETTE_STEPS - 1)));
        (0..PALETTE_STEPS).map(|k| format!("{:x}", colour(k))).collect()
    };
    let hex = |gradient| colours(gradient, |position| position);
    let frame = |frame: Frame| Frame::Ecliptic.to_frame(frame);
    json(&Constants {
        version: env!("CARGO_PKG_VERSION"),
        palettes: [
            ("inferno", hex(colorous::INFERNO)),
            ("cividis", hex(colorous::CIVIDIS)),
            ("viridis", hex(colorous::VIRIDIS)),
            ("difference", colours(colorous::RED_BLUE, |position| 1.0 - position)),
        ],
        frames: [
            ("galactic", frame(Frame::Galactic)),
            ("ecliptic", frame(Frame::Ecliptic)),
            ("equatorial", frame(Frame::Equatorial)),
        ],
        leap_seconds: leap_seconds().collect(),
    })
}

async fn status(State(page): State<PageState>) -> Response {
    json(&page.console.status())
}

async fn config(State(page): State<PageState>) -> Response {
    answer("application/json", page.console.config.clone())
}

/// Runs a slow computation outside of the event loop, one at a time.
async fn run_slow<T: Send + 'static>(
    page: &PageState,
    compute: impl FnOnce() -> T + Send + 'static,
) -> Result<T, Response> {
    let closed = |_| refusal(StatusCode::SERVICE_UNAVAILABLE, "the server is shutting down");
    let _permit = page.slow.acquire().await.map_err(closed)?;
    tokio::task::spawn_blocking(compute).await.map_err(|_| {
        refusal(StatusCode::INTERNAL_SERVER_ERROR, "the response could not be computed: a bug in the program")
    })
}

fn parse_channel(text: &str) -> Option<ChannelId> {
    let is_number =
        text.bytes().all(|digit| digit.is_ascii_digit()) && (text == "0" || !text.starts_with('0'));
    is_number.then(|| text.parse().ok().map(ChannelId))?
}

fn no_map() -> Response {
    refusal(
        StatusCode::NOT_FOUND,
        "no such map is held; expected /api/maps/CHANNEL/N.f32, .fits or .png with N latest, noise, input, sigma, mask, \
         resolution, or a number from `held` of /api/status",
    )
}

fn no_channel() -> Response {
    refusal(StatusCode::NOT_FOUND, "no such channel; expected the number of one, from 0")
}

async fn figures(State(page): State<PageState>, Path(channel): Path<String>) -> Response {
    let Some(channel) = parse_channel(&channel) else { return no_channel() };
    let maps = Arc::clone(&page.console.maps);
    match run_slow(&page, move || maps.figures(channel)).await {
        Ok(Some(figures)) => json(&figures),
        Ok(None) => no_channel(),
        Err(refusal) => refusal,
    }
}

async fn map(State(page): State<PageState>, Path((channel, file)): Path<(String, String)>) -> Response {
    let found = || {
        let (name, kind) = file.split_once('.')?;
        Some((page.console.maps.map(parse_channel(&channel)?, MapChoice::parse(name)?)?, kind))
    };
    let Some((map, kind)) = found() else { return no_map() };
    let encode: fn(&ShownMap) -> Result<Option<Bytes>, String> = match kind {
        "f32" => return answer("application/octet-stream", map.pixels.clone()),
        "fits" => ShownMap::fits,
        "png" => |map| map.png().map(Some),
        _ => return no_map(),
    };
    let content_type = if kind == "fits" { "application/fits" } else { "image/png" };
    match run_slow(&page, move || encode(&map)).await {
        Ok(Ok(Some(bytes))) => answer(content_type, bytes),
        Ok(Ok(None)) => {
            refusal(StatusCode::NOT_FOUND, "only maps of the sky are served as .fits; expected .f32 or .png")
        }
        Ok(Err(error)) => refusal(StatusCode::INTERNAL_SERVER_ERROR, &error),
        Err(refusal) => refusal,
    }
}

/// Packets over mission time; `null` before the instrument is known.
async fn passes(State(page): State<PageState>) -> Response {
    json(&page.console.passes().as_deref())
}

/// Positions of satellites, Moon and Earth; `null` before there are data with positions.
async fn geometry(State(page): State<PageState>) -> Response {
    json(&page.console.geometry())
}

/// The number of a channel of the instrument; any, while the instrument is not known.
fn known_channel(page: &PageState, text: &str) -> Option<ChannelId> {
    let channels = page.console.channels();
    parse_channel(text).filter(|found| channels.is_none_or(|channels| usize::from(found.0) < channels))
}

/// Density of a channel's baselines; `null` if it has none.
async fn uvw(State(page): State<PageState>, Path(channel): Path<String>) -> Response {
    known_channel(&page, &channel).map_or_else(no_channel, |channel| json(&page.console.uvw(channel)))
}

/// Map of a channel's visibilities by direction; `null` if it has none.
async fn hits(State(page): State<PageState>, Path(channel): Path<String>) -> Response {
    let Some(channel) = known_channel(&page, &channel) else { return no_channel() };
    let console = Arc::clone(&page.console);
    match run_slow(&page, move || console.hits(channel)).await {
        Ok(hits) => json(&hits),
        Err(refusal) => refusal,
    }
}

/// Auto-correlation powers of a channel over time; `null` if it has none.
async fn powers(State(page): State<PageState>, Path(channel): Path<String>) -> Response {
    known_channel(&page, &channel).map_or_else(no_channel, |channel| json(&page.console.powers(channel)))
}

async fn gaps(State(page): State<PageState>) -> Response {
    let Some(folder) = page.console.state.clone() else {
        return refusal(
            StatusCode::NOT_FOUND,
            "gaps need a ground segment with a state; expected replay --state DIR",
        );
    };
    match run_slow(&page, move || CoverageSurvey::read(&folder).map(|survey| survey.gaps())).await {
        Ok(Ok(gaps)) => json(&gaps),
        // There may be no checkpoint yet; the error says so, or what is wrong.
        Ok(Err(error)) => refusal(StatusCode::SERVICE_UNAVAILABLE, &error.to_string()),
        Err(refusal) => refusal,
    }
}

async fn metrics(State(page): State<PageState>) -> Response {
    match prometheus::scrape(&page.console) {
        Ok(text) => {
            if page.console.phase() == Phase::Failed {
                page.console.is_failure_scraped.store(true, Ordering::Relaxed);
            }
            answer(prometheus::CONTENT_TYPE, text)
        }
        Err(error) => refusal(StatusCode::INTERNAL_SERVER_ERROR, &error.to_string()),
    }
}

async fn healthz(State(page): State<PageState>) -> Response {
    match page.console.phase() {
        Phase::Failed => refusal(StatusCode::SERVICE_UNAVAILABLE, "failed"),
        phase => answer("text/plain; charset=utf-8", format!("{}\n", phase.name())),
    }
}

async fn readyz(State(page): State<PageState>) -> Response {
    let is_unwritten = |listening: &Listening| {
        listening.archive.as_ref().is_some_and(|archive| archive.report().unwritten.is_some())
    };
    let listening = page.console.handles.get().and_then(|handles| handles.listening.as_ref());
    match page.console.phase() {
        Phase::Running if listening.is_some_and(is_unwritten) => refusal(
            StatusCode::SERVICE_UNAVAILABLE,
            "the raw archive cannot be written: no data are acknowledged",
        ),
        Phase::Running => answer("text/plain; charset=utf-8", "running\n"),
        phase => refusal(StatusCode::SERVICE_UNAVAILABLE, phase.name()),
    }
}

struct EventReader {
    page: PageState,
    /// Number of the last event that was sent.
    last_id: u64,
    /// Events to send, the next one last.
    queue: Vec<Event>,
    _permit: OwnedSemaphorePermit,
}

async fn events(State(page): State<PageState>) -> Response {
    match Arc::clone(&page.readers).try_acquire_owned() {
        Ok(permit) => event_stream(page, permit).into_response(),
        Err(_) => {
            let text = "too many readers of events; /api/status has the same";
            // So that it takes no connection from others.
            ([(CONNECTION, "close")], refusal(StatusCode::SERVICE_UNAVAILABLE, text)).into_response()
        }
    }
}

fn event_stream(
    page: PageState,
    permit: OwnedSemaphorePermit,
) -> Sse<impl Stream<Item = Result<Event, Infallible>>> {
    let mut reader = EventReader { page, last_id: 0, queue: Vec::new(), _permit: permit };
    reader.page.newest_status.mark_changed();
    let next = |mut reader: EventReader| async move {
        loop {
            if let Some(event) = reader.queue.pop() {
                return Some((Ok(event), reader));
            }
            // A slow reader gets the newest status only.
            reader.page.newest_status.changed().await.ok()?;
            let status = Arc::clone(&reader.page.newest_status.borrow_and_update());
            if status.is_empty() {
                continue;
            }
            for entry in reader.page.console.log.after(reader.last_id) {
                reader.last_id = entry.id;
                let text = serde_json::to_string(&entry).unwrap_or_default();
                reader.queue.push(Event::default().event("log").id(entry.id.to_string()).data(text));
            }
            reader.queue.push(Event::default().event("status").data(&*status));
            reader.queue.reverse();
        }
    };
    Sse::new(unfold(reader, next)).keep_alive(KeepAlive::default())
}
