//! The page in a terminal: draws `/api/status` and `/api/figures` with characters.

use ratatui::Frame;
use ratatui::layout::{Alignment, Constraint, Layout, Rect};
use ratatui::style::{Color, Modifier, Style};
use ratatui::symbols::Marker;
use ratatui::text::{Line, Span};
use ratatui::widgets::{Axis, Block, Cell, Chart, Dataset, GraphType, Paragraph, Row, Table};
use serde_json::Value;

use crate::units::constants::DAY_S;
use crate::units::printable;

/// Kinds of packets that are shown.
const KINDS: [&str; 4] = ["instrument", "ephemeris", "visibilities", "housekeeping"];

/// Characters of a queue's bar.
const QUEUE_WIDTH: usize = 10;

/// Greatest and least width of the packets panel, characters; at the least, counts have five characters.
const RECEPTION_WIDTH: u16 = 58;
const RECEPTION_WIDTH_MIN: u16 = 40;

/// Width below which a terminal counts as narrow: columns are left out and numbers get prefixes; no number is cut off.
const NARROW: u16 = 72;

const QUIET: Style = Style::new().fg(Color::DarkGray);
const GOOD: Style = Style::new().fg(Color::Cyan);
const BAD: Style = Style::new().fg(Color::Red).add_modifier(Modifier::BOLD);
const BUSY: Style = Style::new().fg(Color::Yellow);
const HEAD: Style = Style::new().add_modifier(Modifier::BOLD);

/// What is drawn.
#[derive(Clone, Debug, Default)]
pub struct Screen {
    /// Where it comes from.
    pub address: String,
    /// The last `/api/status`.
    pub status: Value,
    /// The last `/api/figures` of the channel shown; null before the first.
    pub figures: Value,
    /// Index of the channel whose curve is shown, in the list of channels.
    pub place: usize,
    /// Why the state shown is not the newest.
    pub lost: Option<String>,
}

impl Screen {
    /// Draws all panels.
    pub fn draw(&self, frame: &mut Frame<'_>) {
        let status = &self.status;
        let stages = list(&status["stages"]).len();
        let width = frame.area().width;
        let reception = RECEPTION_WIDTH.min((width / 2).max(RECEPTION_WIDTH_MIN)).min(width);
        let ledger = self.ledger_lines(usize::from(width - reception).saturating_sub(2));
        let has_ground = !status["reception"].is_null();
        let ground = if has_ground { 2 + (KINDS.len() + 2).max(ledger.len()) } else { 0 };
        let channels = list(&status["channels"]).len();
        let maps = if channels > 0 { 3 + channels.min(8) } else { 0 };
        let rows = [1, stages + 3 + usize::from(!status["solving"].is_null()), ground, maps];
        let rows = rows.map(|rows| Constraint::Length(u16::try_from(rows).unwrap_or(u16::MAX)));
        let [title, chain, ground, maps, curve, keys] =
            Layout::vertical(rows.into_iter().chain([Constraint::Min(0), Constraint::Length(1)]))
                .areas(frame.area());
        frame.render_widget(self.title(usize::from(width)), title);
        self.draw_stages(frame, chain);
        if has_ground {
            let [left, right] =
                Layout::horizontal([Constraint::Fill(1), Constraint::Length(reception)]).areas(ground);
            frame.render_widget(
                Paragraph::new(ledger).block(Block::bordered().title(" Ledger of visibilities ")),
                left,
            );
            self.draw_reception(frame, right);
        }
        if channels > 0 {
            self.draw_maps(frame, maps);
            self.draw_curve(frame, curve);
        }
        frame.render_widget(Line::styled("q quit   \u{2190} \u{2192} channel of the curve", QUIET), keys);
    }

    /// The title, as far as it fits: the address and the segment may be left out.
    fn title(&self, width: usize) -> Line<'_> {
        let status = &self.status;
        let segment = match text(&status["segment"]).as_str() {
            "whole" => "whole chain".to_owned(),
            "space" => "space segment".to_owned(),
            other => other.to_owned(),
        };
        let phase = text(&status["phase"]);
        let (shown, style) = match phase.as_str() {
            "failed" => (phase, BAD),
            "ended" if status["cancelled"] == true => ("ended early".to_owned(), BUSY),
            "running" => (phase, GOOD),
            _ => (phase, HEAD),
        };
        let mut spans = vec![
            Span::styled("lunarray ", HEAD),
            Span::raw(format!("{} \u{b7} {segment} \u{b7} ", text(&status["name"]))),
            Span::styled(shown, style),
            Span::raw(format!(" \u{b7} {}", clock(number(&status["elapsed_s"])))),
        ];
        let address = format!(" \u{b7} {}", self.address);
        let has_room =
            |spans: &[Span<'_>], more: usize| spans.iter().map(Span::width).sum::<usize>() + more <= width;
        if has_room(&spans, address.chars().count()) {
            spans.push(Span::raw(address));
        }
        if !has_room(&spans, 0) {
            spans[1] = Span::raw("");
        }
        if let Some(lost) = &self.lost {
            spans.push(Span::styled(format!("  not connected, last state: {}", printable(lost)), BAD));
        } else if !status["error"].is_null() {
            spans.push(Span::styled(format!("  {}", text(&status["error"])), BAD));
        }
        Line::from(spans)
    }

    fn draw_stages(&self, frame: &mut Frame<'_>, area: Rect) {
        let stages = list(&self.status["stages"]);
        let running = stages.iter().filter(|stage| stage["ended"] != true);
        let most = running.map(|stage| number(&stage["busy"])).fold(0.02, f64::max);
        let rows = stages.iter().map(|stage| {
            let queue = &stage["queue"];
            let (depth, capacity) = (number(&queue["depth"]), number(&queue["capacity"]).max(1.0));
            let bar = match queue.is_null() {
                true => Cell::from(""),
                false => {
                    Cell::from(format!("{} {depth:.0}/{capacity:.0}", bar(depth / capacity, QUEUE_WIDTH)))
                        .style(if depth >= capacity { BUSY } else { GOOD })
                }
            };
            let unit = text(&stage["unit"]);
            let rate = match unit.is_empty() {
                true => format!("{} items", whole(&stage["items_out"])),
                false => format!("{}{unit}/s", prefixed(number(&stage["units_per_s"]))),
            };
            let p99 = |timing: &Value| match number(&timing["count"]) > 0.0 {
                true => duration(number(&timing["p99_s"])),
                false => "\u{2013}".to_owned(),
            };
            let busy = number(&stage["busy"]);
            let style = match stage["ended"] == true {
                true => QUIET,
                false if busy >= most => BUSY,
                false => Style::new(),
            };
            let cells = [
                Cell::from(text(&stage["name"])),
                bar,
                Cell::from(rate),
                Cell::from(p99(&stage["working"])),
                Cell::from(p99(&stage["since_source"])),
                Cell::from(if stage["ended"] == true { "ended".to_owned() } else { percent(busy) }),
            ];
            (cells.to_vec(), style)
        });
        let widths = [12, QUEUE_WIDTH as u16 + 12, 0, 10, 10, 6].map(|width| match width {
            0 => Constraint::Fill(1),
            width => Constraint::Length(width),
        });
        let head = ["stage", "queue before it", "rate", "step p99", "age p99", "busy"];
        let block = Block::bordered().title(" Stages ");
        let inner = block.inner(area);
        let is_shown = |column: &usize| inner.width >= NARROW || ![3, 4].contains(column);
        let table = table_of(&head, rows.collect(), &widths, is_shown);
        frame.render_widget(block, area);
        let [table_area, solver] = Layout::vertical([
            Constraint::Fill(1),
            Constraint::Length(u16::from(!self.status["solving"].is_null())),
        ])
        .areas(inner);
        frame.render_widget(table, table_area);
        frame.render_widget(self.solver(usize::from(solver.width)), solver);
    }

    fn solver(&self, width: usize) -> Line<'_> {
        let solving = &self.status["solving"];
        if solving.is_null() {
            return Line::default();
        }
        let (residual, target) = (number(&solving["residual"]), number(&solving["target"]));
        let left = match solving["left_s"].as_f64() {
            Some(left_s) => format!(", about {} left", clock(left_s)),
            None => String::new(),
        };
        let done = (residual.ln() / target.ln()).clamp(0.0, 1.0);
        let iteration = whole(&solving["iteration"]);
        let short = format!("iteration {iteration}, residual {residual:.1e} of {target:.0e}");
        let long = format!("{} {}: {short}{left}", bar(done, QUEUE_WIDTH), text(&solving["what"]));
        Line::styled(if long.chars().count() <= width { long } else { short }, BUSY)
    }

    fn ledger_lines(&self, width: usize) -> Vec<Line<'static>> {
        // Numbers first: names may be cut.
        let digits = 15.min((width / 2).max(7));
        let ledger = &self.status["ledger"];
        let phase = text(&self.status["phase"]);
        let is_over = phase == "ended" || phase == "failed";
        // Null while it is not known.
        let rest = ledger["unaccounted"].as_f64().unwrap_or(0.0);
        let (verdict, style) = match (is_over, rest == 0.0) {
            (true, true) => ("closed".to_owned(), GOOD),
            (true, false) => (format!("does not close: {} unaccounted", count(rest)), BAD),
            (false, _) => ("open while data flow".to_owned(), QUIET),
        };
        let entry = |name: String, value: &Value| {
            Line::from(format!("{:>digits$}  {name}", fit(number(value), digits)))
        };
        let mut lines = vec![Line::styled(verdict, style)];
        lines.push(match ledger["sampled"].is_null() {
            true => Line::from(format!("{:>digits$}  sampled: told at the end", "\u{2013}")),
            false => entry("sampled".into(), &ledger["sampled"]),
        });
        lines.push(entry("accumulated".into(), &ledger["accumulated"]));
        if let Some(flagged) = ledger["flagged"].as_object() {
            lines.extend(
                flagged.iter().map(|(reason, count)| entry(format!("flagged: {}", printable(reason)), count)),
            );
        }
        lines.extend(list(&ledger["lost"]).iter().map(|lost| {
            entry(format!("lost in {}: {}", text(&lost["stage"]), text(&lost["reason"])), &lost["count"])
        }));
        lines
    }

    fn draw_reception(&self, frame: &mut Frame<'_>, area: Rect) {
        let reception = &self.status["reception"];
        // Four columns beside the names, a space before each.
        let digits = usize::from(area.width.saturating_sub(2 + 12 + 4) / 4);
        let cell = |value: &Value, is_bad: bool| {
            let style = if is_bad && number(value) > 0.0 { BAD } else { Style::new() };
            Cell::from(Line::from(fit(number(value), digits)).right_aligned()).style(style)
        };
        let rows = KINDS.map(|kind| {
            let of = &reception[kind];
            Row::new([
                Cell::from(kind),
                cell(&of["packets"], false),
                cell(&of["missing"], true),
                cell(&of["damaged"], true),
                cell(&of["duplicates"], false),
            ])
        });
        let head = ["packets", "received", "missing", "damaged", "again"];
        let head = head.map(|name| {
            Line::from(name).alignment(if name == "packets" { Alignment::Left } else { Alignment::Right })
        });
        let widths = [
            Constraint::Length(12),
            Constraint::Fill(1),
            Constraint::Fill(1),
            Constraint::Fill(1),
            Constraint::Fill(1),
        ];
        let listening = &self.status["listening"];
        let from = match listening.is_null() {
            true => format!("{}B received", prefixed(number(&reception["bytes"]))),
            false => format!(
                "{} senders, {}B read, {}B wait",
                whole(&listening["open"]),
                prefixed(number(&listening["bytes"])),
                prefixed(number(&listening["backlog_bytes"]))
            ),
        };
        let has_room = from.chars().count() + 4 <= usize::from(area.width);
        let from = if has_room { from } else { format!("{}B read", prefixed(number(&listening["bytes"]))) };
        let mut block = Block::bordered().title(" Reception ").title_bottom(format!(" {from} "));
        if !self.status["saving"]["unsaved"].is_null() {
            block = block.title(Line::styled(" state not saved ", BAD));
        }
        let table = Table::new(rows, widths).header(Row::new(head).style(QUIET)).block(block);
        frame.render_widget(table, area);
    }

    fn draw_maps(&self, frame: &mut Frame<'_>, area: Rect) {
        let channels = list(&self.status["channels"]);
        let first = self.place.saturating_sub(7).min(channels.len().saturating_sub(1));
        let rows = channels.iter().enumerate().skip(first).map(|(place, channel)| {
            let figures = &channel["figures"];
            let name = match channel["is_final"] == true {
                true => "final".to_owned(),
                false => format!("snapshot {}", whole(&figures["number"])),
            };
            let span = &channel["span_s"];
            let days = (number(&span[1]) - number(&span[0])) / DAY_S;
            let cells = [
                if place == self.place { "\u{25b8}".to_owned() } else { String::new() },
                whole(&channel["channel"]),
                format!("{:.3}", number(&channel["frequency_hz"]) / 1e6),
                name,
                format!("{days:.1}"),
                fit(number(&figures["visibilities"]), 15),
                short(&channel["noise_rms_k"]),
                short(&figures["rms_error_over_rms_truth"]),
                short(&figures["rho_mean"]),
            ];
            (cells.map(Cell::from).to_vec(), if place == self.place { HEAD } else { Style::new() })
        });
        let head = ["", "ch", "MHz", "map", "days", "visibilities", "noise, K", "error", "rho"];
        let lengths = [1_u16, 4, 8, 13, 8, 15, 10, 9, 9];
        // These are left out first where there is no room.
        let mut left_out = Vec::new();
        let mut needed = lengths.iter().map(|length| length + 1).sum::<u16>() + 1;
        for column in [8, 7, 3, 4] {
            if needed > area.width {
                needed -= lengths[column] + 1;
                left_out.push(column);
            }
        }
        let widths = lengths.map(Constraint::Length);
        let table = table_of(&head, rows.collect(), &widths, |column| !left_out.contains(column));
        frame.render_widget(table.block(Block::bordered().title(" Maps ")), area);
    }

    fn draw_curve(&self, frame: &mut Frame<'_>, area: Rect) {
        let spectra = &self.figures["spectra"];
        let by_degree = |values: &Value, of: fn(f64) -> f64| -> Vec<(f64, f64)> {
            let values = list(values).iter().enumerate().skip(1);
            values
                .filter_map(|(l, v)| Some((l as f64, of(v.as_f64()?))))
                .filter(|(_, v)| v.is_finite())
                .collect()
        };
        let is_rho = !list(&spectra["rho"]).is_empty();
        let (title, points) = match is_rho {
            true => (
                " rho_l: correlation of the map with the input, by degree ",
                by_degree(&spectra["rho"], |v| v),
            ),
            // The ground does not know the truth.
            false => {
                (" C_l of the map, log10 of K\u{b2}, by degree ", by_degree(&spectra["cl_map"], f64::log10))
            }
        };
        let block = Block::bordered().title(title);
        let (Some(first), Some(last)) = (points.first(), points.last()) else {
            frame.render_widget(Paragraph::new(Line::styled("no curve yet", QUIET)).block(block), area);
            return;
        };
        let x = [first.0, last.0.max(first.0 + 1.0)];
        let y = match is_rho {
            true => [0.0, 1.0],
            false => {
                let least = points.iter().fold(f64::INFINITY, |least, p| least.min(p.1)).floor();
                let most = points.iter().fold(f64::NEG_INFINITY, |most, p| most.max(p.1)).ceil();
                [least, most.max(least + 1.0)]
            }
        };
        let labels =
            |[low, high]: [f64; 2]| [format!("{low}"), format!("{}", 0.5 * (low + high)), format!("{high}")];
        let line =
            Dataset::default().marker(Marker::Braille).graph_type(GraphType::Line).style(GOOD).data(&points);
        let chart = Chart::new(vec![line])
            .x_axis(Axis::default().bounds(x).labels(labels(x)).style(QUIET))
            .y_axis(Axis::default().bounds(y).labels(labels(y)).style(QUIET))
            .block(block);
        frame.render_widget(chart, area);
    }
}

/// The entries of a list; none if it is not there.
fn list(value: &Value) -> &[Value] {
    value.as_array().map_or(&[], Vec::as_slice)
}

/// A number; 0 if it is not there.
fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or(0.0)
}

/// A text without control characters; empty if it is absent.
fn text(value: &Value) -> String {
    printable(value.as_str().unwrap_or_default()).into_owned()
}

/// A whole number in groups of three digits.
fn whole(value: &Value) -> String {
    count(number(value))
}

fn count(number: f64) -> String {
    let digits = format!("{:.0}", number.abs());
    let mut grouped = String::from(if number < 0.0 { "-" } else { "" });
    for (k, digit) in digits.chars().enumerate() {
        if k > 0 && (digits.len() - k).is_multiple_of(3) {
            grouped.push(',');
        }
        grouped.push(digit);
    }
    grouped
}

/// A whole number in at most `width` characters: with a prefix if its digits do not fit.
fn fit(number: f64, characters: usize) -> String {
    let all = count(number);
    if all.chars().count() <= characters {
        return all;
    }
    let scales = [(1e15, 'P'), (1e12, 'T'), (1e9, 'G'), (1e6, 'M'), (1e3, 'k')];
    let scaled = scales.into_iter().find(|(size, _)| number.abs() >= *size);
    let Some((size, prefix)) = scaled else { return "#".repeat(characters) };
    let texts = [1, 0].map(|digits| format!("{:.digits$}{prefix}", number / size));
    let fitting = texts.into_iter().find(|text| text.chars().count() <= characters);
    fitting.unwrap_or_else(|| "#".repeat(characters))
}

/// A table of the columns that are shown.
fn table_of<'a>(
    head: &[&'static str],
    rows: Vec<(Vec<Cell<'a>>, Style)>,
    widths: &[Constraint],
    is_shown: impl Fn(&usize) -> bool,
) -> Table<'a> {
    let shown: Vec<usize> = (0..head.len()).filter(is_shown).collect();
    let rows = rows.into_iter().map(|(cells, style)| {
        let cells: Vec<Cell<'a>> = shown.iter().filter_map(|&column| cells.get(column).cloned()).collect();
        Row::new(cells).style(style)
    });
    let head: Vec<&'static str> = shown.iter().map(|&column| head[column]).collect();
    Table::new(rows, shown.iter().map(|&column| widths[column])).header(Row::new(head).style(QUIET))
}

/// A number with a few digits; a dash if it is not there.
fn short(value: &Value) -> String {
    match value.as_f64() {
        None => "\u{2013}".to_owned(),
        Some(v) if v != 0.0 && !(1e-2..1e5).contains(&v.abs()) => format!("{v:.2e}"),
        Some(v) => format!("{v:.3}"),
    }
}

/// A rate: three digits and the prefix of its unit.
fn prefixed(value: f64) -> String {
    let scales = [(1e9, " G"), (1e6, " M"), (1e3, " k")];
    match scales.into_iter().find(|(size, _)| value >= *size) {
        Some((size, prefix)) => format!("{:.1}{prefix}", value / size),
        None => format!("{value:.0} "),
    }
}

fn percent(share: f64) -> String {
    format!("{:.0} %", 100.0 * share)
}

fn duration(seconds: f64) -> String {
    match seconds {
        s if s >= 1.0 => format!("{s:.2} s"),
        s if s >= 1e-3 => format!("{:.1} ms", 1e3 * s),
        s => format!("{:.0} \u{b5}s", 1e6 * s),
    }
}

fn clock(seconds: f64) -> String {
    let s = seconds.max(0.0) as u64;
    match s / 3600 {
        0 => format!("{}:{:02}", s / 60, s % 60),
        hours => format!("{hours}:{:02}:{:02}", s / 60 % 60, s % 60),
    }
}

fn bar(share: f64, width: usize) -> String {
    let full = (share.clamp(0.0, 1.0) * width as f64).round() as usize;
    format!("{}{}", "\u{2588}".repeat(full), "\u{2591}".repeat(width - full))
}

#[cfg(test)]
mod tests {
    use ratatui::Terminal;
    use ratatui::backend::TestBackend;
    use serde_json::json;

    use super::*;

    fn drawn(screen: &Screen, width: u16, height: u16) -> String {
        let mut terminal = Terminal::new(TestBackend::new(width, height)).unwrap();
        terminal.draw(|frame| screen.draw(frame)).unwrap();
        let buffer = terminal.backend().buffer().clone();
        let line = |y| (0..width).map(|x| buffer[(x, y)].symbol()).collect::<String>() + "\n";
        (0..height).map(line).collect()
    }

    fn running() -> Screen {
        let timing = json!({"count": 5, "p99_s": 0.0025});
        let stage = |name: &str, busy: f64, queue: Value| {
            json!({"name": name, "items_out": 7, "unit": "bytes", "units_per_s": 2_500_000.0, "busy": busy,
                "ended": false, "queue": queue, "working": timing, "since_source": timing})
        };
        let kind = json!({"packets": 1234, "missing": 5, "damaged": 0, "duplicates": 6});
        let rho: Vec<f64> = (0..20).map(|l| 1.0 - 0.04 * f64::from(l)).collect();
        Screen {
            address: "127.0.0.1:8080".into(),
            status: json!({
                "name": "small\u{1b}[2J", "segment": "ground", "phase": "running", "elapsed_s": 3725.0, "cancelled": false,
                "stages": [stage("read", 0.1, Value::Null), stage("ground", 0.9, json!({"depth": 4, "capacity": 8}))],
                "solving": {"what": "map at 3 MHz", "iteration": 12, "residual": 1e-3, "target": 1e-6, "left_s": 61.0},
                "ledger": {"sampled": 0, "accumulated": 1_234_567, "unaccounted": 0, "flagged": {"occulted": 89},
                    "lost": [{"stage": "link", "reason": "not received", "count": 10}]},
                "reception": {"bytes": 4_200_000.0, "instrument": kind, "ephemeris": kind, "visibilities": kind, "housekeeping": kind},
                "channels": [{"channel": 0, "frequency_hz": 3e6, "is_final": false, "span_s": [0.0, 864_000.0], "noise_rms_k": 1.5e6,
                    "figures": {"number": 3, "visibilities": 1_000_000, "rms_error_over_rms_truth": 0.25, "rho_mean": 0.75}}],
            }),
            figures: json!({"spectra": {"rho": rho}}),
            ..Screen::default()
        }
    }

    #[test]
    fn all_panels_are_drawn() {
        let text = drawn(&running(), 110, 46);
        for words in [
            "lunarray small\\u{1b}[2J \u{b7} ground \u{b7} running \u{b7} 1:02:05 \u{b7} 127.0.0.1:8080",
            "\u{2588}\u{2588}\u{2588}\u{2588}\u{2588}\u{2591}\u{2591}\u{2591}\u{2591}\u{2591} 4/8",
            "2.5 Mbytes/s",
            "2.5 ms",
            "90 %",
            // Half of the way from 1 to 1e-6, in the logarithm.
            "\u{2588}\u{2588}\u{2588}\u{2588}\u{2588}\u{2591}\u{2591}\u{2591}\u{2591}\u{2591} map at 3 MHz: iteration 12, residual 1.0e-3 of 1e-6, about 1:01 left",
            "1,234,567  accumulated",
            "89  flagged: occulted",
            "10  lost in link: not received",
            "4.2 MB received",
            "3.000",
            "snapshot 3",
            "1,000,000",
            "1.50e6",
            "0.250",
            "rho_l",
            "q quit",
        ] {
            assert!(text.contains(words), "no `{words}` in\n{text}");
        }
        let reception = text.lines().find(|line| line.contains("\u{2502}visibilities ")).unwrap();
        let words: Vec<&str> =
            reception.trim_end_matches('\u{2502}').split_whitespace().rev().take(4).collect();
        assert_eq!(words, ["6", "0", "5", "1,234"], "{text}");
        // Only the curve has dots.
        assert!(text.chars().filter(|c| ('\u{2801}'..='\u{28ff}').contains(c)).count() > 20, "{text}");
        assert!(!text.contains('\u{1b}'));
    }

    #[test]
    fn what_is_not_there_or_does_not_fit_is_left_out() {
        // Any size, and before anything is known.
        for (width, height) in [(1, 1), (20, 5), (80, 24), (300, 100)] {
            drawn(&running(), width, height);
            drawn(&Screen::default(), width, height);
        }
        let mut space = running();
        for key in ["reception", "ledger", "solving"] {
            space.status[key] = Value::Null;
        }
        space.status["channels"] = json!([]);
        let text = drawn(&space, 100, 30);
        assert!(!text.contains("Ledger") && !text.contains("Maps") && text.contains("Stages"), "{text}");
        let mut lost = running();
        lost.lost = Some("refused".into());
        assert!(drawn(&lost, 120, 30).contains("not connected, last state: refused"));
        let mut open = running();
        open.status["phase"] = json!("ended");
        open.status["ledger"]["unaccounted"] = json!(17);
        open.figures = json!({"spectra": {"cl_map": [0.0, 1e4, 1e5, 1e3]}});
        let text = drawn(&open, 100, 46);
        assert!(text.contains("does not close: 17 unaccounted") && text.contains("C_l of the map"), "{text}");
    }

    #[test]
    fn no_digit_is_cut_off() {
        let mut screen = running();
        let kind =
            json!({"packets": 123_456_789, "missing": 5_000_000_u64, "damaged": 0, "duplicates": 12_345});
        for name in KINDS {
            screen.status["reception"][name] = kind.clone();
        }
        screen.status["ledger"]["accumulated"] = json!(98_765_432_109_876_u64);
        screen.status["channels"][0]["figures"]["visibilities"] = json!(98_765_432_109_876_u64);
        for (width, height) in [(60, 40), (80, 24), (80, 40), (100, 40), (120, 50)] {
            let text = drawn(&screen, width, height);
            let row = text.lines().find(|line| line.contains("\u{2502}ephemeris ")).unwrap();
            let words: Vec<&str> =
                row.trim_end_matches('\u{2502}').split_whitespace().rev().take(4).collect();
            // All digits, or fewer with a prefix.
            let expected = [
                &["12,345", "12.3k", "12k"][..],
                &["0"],
                &["5,000,000", "5.0M", "5M"],
                &["123,456,789", "123.5M", "123M"],
            ];
            for (word, expected) in words.iter().zip(expected) {
                assert!(expected.contains(word), "{word} at {width}:\n{text}");
            }
            let of_ledger = text.lines().find(|line| line.contains("  accu")).unwrap();
            let number = of_ledger.trim_start_matches('\u{2502}').split_whitespace().next().unwrap();
            assert!(["98,765,432,109,876", "98.8T", "99T"].contains(&number), "{number} at {width}:\n{text}");
            if let Some(map) = text.lines().find(|line| line.contains("   3.000 ")) {
                assert!(map.contains(" 98.8T ") && map.contains("1.50e6"), "{width}:\n{text}");
            }
            assert!(text.contains("running \u{b7} 1:02:05"), "{width}:\n{text}");
            assert!(text.contains("residual 1.0e-3 of 1e-6"), "{width}:\n{text}");
        }
    }

    #[test]
    fn numbers_are_readable() {
        assert_eq!(
            [0.0, 999.0, 1000.0, 1234567.0, -1234.0].map(count),
            ["0", "999", "1,000", "1,234,567", "-1,234"]
        );
        assert_eq!([0.0, 61.0, 36_061.0].map(clock), ["0:00", "1:01", "10:01:01"]);
        assert_eq!([2e-6, 0.0025, 3.0].map(duration), ["2 \u{b5}s", "2.5 ms", "3.00 s"]);
        assert_eq!([12.0, 1.5e3, 2e6, 3e9].map(prefixed), ["12 ", "1.5 k", "2.0 M", "3.0 G"]);
        assert_eq!(
            [-1.0, 0.0, 0.5, 2.0].map(|share| bar(share, 2)),
            ["\u{2591}\u{2591}", "\u{2591}\u{2591}", "\u{2588}\u{2591}", "\u{2588}\u{2588}"]
        );
    }
}
