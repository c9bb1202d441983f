//! The status of a run in a terminal: draws `/api/status` and `/api/figures`.

use ratatui::Frame;
use ratatui::layout::{Alignment, Constraint, Layout, Rect};
use ratatui::style::{Color, Modifier, Style};
use ratatui::symbols::Marker;
use ratatui::text::{Line, Span};
use ratatui::widgets::{Axis, Block, Cell, Chart, Dataset, GraphType, Paragraph, Row, Table};
use serde_json::Value;

use super::screen_text::{
    as_number, as_text, bar, clock, duration, format_integer, format_short, format_within, group_digits,
    list, percent, with_prefix,
};
use crate::units::constants::DAY_S;
use crate::units::printable;

const KINDS: [&str; 4] = ["instrument", "ephemeris", "visibilities", "housekeeping"];

const BAR_WIDTH: usize = 10;

/// Preferred width of the packets panel, characters.
const RECEPTION_WIDTH: u16 = 58;
/// Minimum width of the packets panel, characters, with five for each count.
const RECEPTION_WIDTH_MIN: u16 = 40;

/// Maximum number of channels in the panel of maps.
const CHANNELS_MAX: usize = 8;

/// A stage below this fraction of the time is never highlighted as the busiest.
const BUSY_MIN: f64 = 0.02;

/// Width below which columns are left out and numbers get prefixes, characters.
const NARROW: u16 = 72;

const QUIET: Style = Style::new().fg(Color::DarkGray);
const GOOD: Style = Style::new().fg(Color::Cyan);
const BAD: Style = Style::new().fg(Color::Red).add_modifier(Modifier::BOLD);
const BUSY: Style = Style::new().fg(Color::Yellow);
const HEAD: Style = Style::new().add_modifier(Modifier::BOLD);

/// Content of the terminal.
#[derive(Clone, Debug, Default)]
pub struct Screen {
    /// Address of the server.
    pub address: String,
    /// The last `/api/status`.
    pub status: Value,
    /// The last `/api/figures` of the selected channel; null before the first.
    pub figures: Value,
    /// Index of the selected channel in the list of channels.
    pub channel_index: usize,
    /// Reason of a lost connection; the status is then the last one received.
    pub disconnected_because: Option<String>,
}

impl Screen {
    /// Draws all panels.
    pub fn draw(&self, frame: &mut Frame<'_>) {
        let status = &self.status;
        let Rect { width, height, .. } = frame.area();
        let height = usize::from(height);
        let reception = RECEPTION_WIDTH.min((width / 2).max(RECEPTION_WIDTH_MIN)).min(width);
        let mut ledger = self.ledger_lines(usize::from(width - reception).saturating_sub(2));
        // Title, keys, one stage, one channel, and frames take 13 lines.
        let ledger_max = height.saturating_sub(13).max(KINDS.len() + 2);
        if ledger.len() > ledger_max {
            let more = format!("and {} more lines", ledger.len() + 1 - ledger_max);
            ledger.truncate(ledger_max - 1);
            ledger.push(Line::styled(more, QUIET));
        }
        let has_ground = !status["reception"].is_null();
        let ground = if has_ground { 2 + (KINDS.len() + 2).max(ledger.len()) } else { 0 };
        // In a low terminal, stages and channels share what is left; at least one of each is shown.
        let left = height.saturating_sub(2 + ground);
        let frame_of_stages = 3 + usize::from(!status["solving"].is_null());
        let channels = list(&status["channels"]).len();
        let channels_shown = channels.min(CHANNELS_MAX).min(left.saturating_sub(4 + frame_of_stages).max(1));
        let maps = if channels > 0 { 3 + channels_shown } else { 0 };
        let stages = list(&status["stages"]).len();
        let stages_shown = stages.min(left.saturating_sub(maps + frame_of_stages).max(1));
        let rows = [1, stages_shown + frame_of_stages, ground, maps];
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

    /// The title line. Without enough width, the address and the segment are left out.
    fn title(&self, width: usize) -> Line<'_> {
        let status = &self.status;
        let segment = match as_text(&status["segment"]).as_str() {
            "whole" => "whole chain".to_owned(),
            "space" => "space segment".to_owned(),
            other => other.to_owned(),
        };
        let phase = as_text(&status["phase"]);
        let (shown, style) = match phase.as_str() {
            "failed" => (phase, BAD),
            "ended" if status["cancelled"] == true => ("ended early".to_owned(), BUSY),
            "running" => (phase, GOOD),
            _ => (phase, HEAD),
        };
        let mut spans = vec![
            Span::styled("lunarray ", HEAD),
            Span::raw(format!("{} \u{b7} {segment} \u{b7} ", as_text(&status["name"]))),
            Span::styled(shown, style),
            Span::raw(format!(" \u{b7} {}", clock(as_number(&status["elapsed_s"])))),
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
        if let Some(reason) = &self.disconnected_because {
            let text = format!("  not connected ({}); showing the last state", printable(reason));
            spans.push(Span::styled(text, BAD));
        } else if !status["error"].is_null() {
            spans.push(Span::styled(format!("  {}", as_text(&status["error"])), BAD));
        }
        Line::from(spans)
    }

    fn draw_stages(&self, frame: &mut Frame<'_>, area: Rect) {
        let stages = list(&self.status["stages"]);
        let running = stages.iter().filter(|stage| stage["ended"] != true);
        let busiest = running.map(|stage| as_number(&stage["busy"])).fold(BUSY_MIN, f64::max);
        let has_solver = u16::from(!self.status["solving"].is_null());
        let block = Block::bordered();
        let inner = block.inner(area);
        let shown = busiest_of(stages, usize::from(inner.height.saturating_sub(1 + has_solver)));
        let title = match shown.len() == stages.len() {
            true => " Stages ".to_owned(),
            false => format!(" Stages: the {} busiest of {} ", shown.len(), stages.len()),
        };
        let rows = shown.into_iter().map(|stage| {
            let queue = &stage["queue"];
            let (depth, capacity) = (as_number(&queue["depth"]), as_number(&queue["capacity"]).max(1.0));
            let bar = match queue.is_null() {
                true => Cell::from(""),
                false => Cell::from(format!("{} {depth:.0}/{capacity:.0}", bar(depth / capacity, BAR_WIDTH)))
                    .style(if depth >= capacity { BUSY } else { GOOD }),
            };
            let unit = as_text(&stage["unit"]).replace("visibilities", "vis").replace("bytes", "B");
            let rate = match unit.is_empty() {
                true => format!("{} items", format_integer(&stage["items_out"])),
                false => format!("{}{unit}/s", with_prefix(as_number(&stage["units_per_s"]))),
            };
            let p99 = |timing: &Value| match as_number(&timing["count"]) > 0.0 {
                true => duration(as_number(&timing["p99_s"])),
                false => "\u{2013}".to_owned(),
            };
            let busy = as_number(&stage["busy"]);
            let style = match stage["ended"] == true {
                true => QUIET,
                false if busy >= busiest => BUSY,
                false => Style::new(),
            };
            let cells = [
                Cell::from(as_text(&stage["name"])),
                bar,
                Cell::from(rate),
                Cell::from(p99(&stage["working"])),
                Cell::from(p99(&stage["since_source"])),
                Cell::from(if stage["ended"] == true { "ended".to_owned() } else { percent(busy) }),
            ];
            (cells.to_vec(), style)
        });
        let widths = [12, BAR_WIDTH as u16 + 12, 0, 10, 11, 6].map(|width| match width {
            0 => Constraint::Fill(1),
            width => Constraint::Length(width),
        });
        let head = ["stage", "input queue", "rate", "step p99", "latency p99", "busy"];
        let is_shown = |column: &usize| inner.width >= NARROW || ![3, 4].contains(column);
        let table = table_of(&head, rows.collect(), &widths, is_shown);
        frame.render_widget(block.title(title), area);
        let [table_area, solver] =
            Layout::vertical([Constraint::Fill(1), Constraint::Length(has_solver)]).areas(inner);
        frame.render_widget(table, table_area);
        frame.render_widget(self.solver(usize::from(solver.width)), solver);
    }

    fn solver(&self, width: usize) -> Line<'_> {
        let solving = &self.status["solving"];
        if solving.is_null() {
            return Line::default();
        }
        let (residual, target) = (as_number(&solving["residual"]), as_number(&solving["target"]));
        let left = match solving["left_s"].as_f64() {
            Some(left_s) => format!(", about {} left", clock(left_s)),
            None => String::new(),
        };
        let done = (residual.ln() / target.ln()).clamp(0.0, 1.0);
        let iteration = format_integer(&solving["iteration"]);
        let short = format!("iteration {iteration}, residual {residual:.1e} of {target:.0e}");
        let long = format!("{} {}: {short}{left}", bar(done, BAR_WIDTH), as_text(&solving["what"]));
        Line::styled(if long.chars().count() <= width { long } else { short }, BUSY)
    }

    fn ledger_lines(&self, width: usize) -> Vec<Line<'static>> {
        // Numbers come first, as names may be truncated.
        let digits = 15.min((width / 2).max(7));
        let ledger = &self.status["ledger"];
        let phase = as_text(&self.status["phase"]);
        let is_over = phase == "ended" || phase == "failed";
        // Null until the end of the run, and in one that failed.
        let (balance, style) = match ledger["unaccounted"].as_f64() {
            Some(0.0) if is_over => ("balanced".to_owned(), GOOD),
            Some(unaccounted) if is_over => {
                (format!("imbalance: {} unaccounted", group_digits(unaccounted)), BAD)
            }
            None if is_over => ("balance unknown: the run failed".to_owned(), QUIET),
            _ => ("not final while running".to_owned(), QUIET),
        };
        let entry = |name: String, value: &Value| {
            Line::from(format!("{:>digits$}  {name}", format_within(as_number(value), digits)))
        };
        let mut lines = vec![Line::styled(balance, style)];
        lines.push(match ledger["sampled"].is_null() {
            true => Line::from(format!("{:>digits$}  sampled: known at the end", "\u{2013}")),
            false => entry("sampled".into(), &ledger["sampled"]),
        });
        lines.push(entry("accumulated".into(), &ledger["accumulated"]));
        if let Some(flagged) = ledger["flagged"].as_object() {
            lines.extend(
                flagged.iter().map(|(reason, count)| entry(format!("flagged: {}", printable(reason)), count)),
            );
        }
        lines.extend(list(&ledger["lost"]).iter().map(|lost| {
            entry(
                format!("lost in {}: {}", as_text(&lost["stage"]), as_text(&lost["reason"])),
                &lost["count"],
            )
        }));
        lines
    }

    fn draw_reception(&self, frame: &mut Frame<'_>, area: Rect) {
        let reception = &self.status["reception"];
        // Four columns after the names, with a space before each.
        let digits = usize::from(area.width.saturating_sub(2 + 12 + 4) / 4);
        let cell = |value: &Value, is_bad: bool| {
            let style = if is_bad && as_number(value) > 0.0 { BAD } else { Style::new() };
            Cell::from(Line::from(format_within(as_number(value), digits)).right_aligned()).style(style)
        };
        let rows = KINDS.map(|kind| {
            let counts = &reception[kind];
            Row::new([
                Cell::from(kind),
                cell(&counts["packets"], false),
                cell(&counts["missing"], true),
                cell(&counts["damaged"], true),
                cell(&counts["duplicates"], false),
            ])
        });
        let head = ["packets", "received", "missing", "damaged", "duplicates"];
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
            true => format!("{}B received", with_prefix(as_number(&reception["bytes"]))),
            false => format!(
                "{} senders, {}B read, {}B queued",
                format_integer(&listening["open"]),
                with_prefix(as_number(&listening["bytes"])),
                with_prefix(as_number(&listening["backlog_bytes"]))
            ),
        };
        let has_room = from.chars().count() + 4 <= usize::from(area.width);
        let from =
            if has_room { from } else { format!("{}B read", with_prefix(as_number(&listening["bytes"]))) };
        let mut block = Block::bordered().title(" Reception ").title_bottom(format!(" {from} "));
        if !self.status["saving"]["unsaved"].is_null() {
            block = block.title(Line::styled(" state not saved ", BAD));
        }
        let table = Table::new(rows, widths).header(Row::new(head).style(QUIET)).block(block);
        frame.render_widget(table, area);
    }

    fn draw_maps(&self, frame: &mut Frame<'_>, area: Rect) {
        let channels = list(&self.status["channels"]);
        let shown = usize::from(area.height.saturating_sub(3));
        let first = (self.channel_index + 1).saturating_sub(shown).min(channels.len().saturating_sub(1));
        let rows = channels.iter().enumerate().skip(first).map(|(index, channel)| {
            let figures = &channel["figures"];
            let name = match channel["is_final"] == true {
                true => "final".to_owned(),
                false => format!("snapshot {}", format_within(as_number(&figures["number"]), 6)),
            };
            let span = &channel["span_s"];
            let days = (as_number(&span[1]) - as_number(&span[0])) / DAY_S;
            let cells = [
                if index == self.channel_index { "\u{25b8}".to_owned() } else { String::new() },
                format_integer(&channel["channel"]),
                format!("{:.3}", as_number(&channel["frequency_hz"]) / 1e6),
                name,
                format!("{days:.1}"),
                format_within(as_number(&figures["visibilities"]), 15),
                format_short(&channel["noise_rms_k"]),
                format_short(&figures["rms_error_over_rms_truth"]),
                format_short(&figures["rho_mean"]),
            ];
            (cells.map(Cell::from).to_vec(), if index == self.channel_index { HEAD } else { Style::new() })
        });
        let head = ["", "ch", "MHz", "map", "days", "visibilities", "noise, K", "error", "rho"];
        let lengths = [1_u16, 5, 8, 15, 8, 15, 10, 9, 9];
        // Columns 8, 7, 3 and 4 are left out, in this order, if the width is too small.
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
        let title = match channels.len() > shown {
            true => format!(" Maps of {shown} of {} channels ", channels.len()),
            false => " Maps ".to_owned(),
        };
        frame.render_widget(table.block(Block::bordered().title(title)), area);
    }

    fn draw_curve(&self, frame: &mut Frame<'_>, area: Rect) {
        let spectra = &self.figures["spectra"];
        let by_degree = |values: &Value, transform: fn(f64) -> f64| -> Vec<(f64, f64)> {
            let values = list(values).iter().enumerate().skip(1);
            values
                .filter_map(|(l, v)| Some((l as f64, transform(v.as_f64()?))))
                .filter(|(_, v)| v.is_finite())
                .collect()
        };
        let is_rho = !list(&spectra["rho"]).is_empty();
        let (title, points) = match is_rho {
            true => (
                " rho_l: correlation of the map with the input, by degree ",
                by_degree(&spectra["rho"], |v| v),
            ),
            // Without an input sky there is no correlation.
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
                let min = points.iter().fold(f64::INFINITY, |min, p| min.min(p.1)).floor();
                let max = points.iter().fold(f64::NEG_INFINITY, |max, p| max.max(p.1)).ceil();
                [min, max.max(min + 1.0)]
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

/// The busiest stages, at most `count`, running ones first, in the order of the data's path.
fn busiest_of(stages: &[Value], count: usize) -> Vec<&Value> {
    let mut order: Vec<usize> = (0..stages.len()).collect();
    let idle = |k: &usize| (stages[*k]["ended"] == true, -as_number(&stages[*k]["busy"]));
    order.sort_by(|a, b| idle(a).partial_cmp(&idle(b)).unwrap_or(std::cmp::Ordering::Equal));
    order.truncate(count);
    order.sort_unstable();
    order.into_iter().map(|k| &stages[k]).collect()
}

/// Makes a table of the columns for which `is_shown` is true.
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
            "2.5 MB/s",
            "2.5 ms",
            "90 %",
            // A residual of 1e-3 is half of the way from 1 to 1e-6, in the logarithm.
            "\u{2588}\u{2588}\u{2588}\u{2588}\u{2588}\u{2591}\u{2591}\u{2591}\u{2591}\u{2591} map at 3 MHz: iteration 12, residual 1.0e-3 of 1e-6, about 1:01 left",
            "1,234,567  accumulated",
            "89  flagged: occulted",
            "10  lost in link: not received",
            "4.2 MB received",
            "3.000",
            "snapshot 3",
            "1,000,000",
            "1.500e6",
            "0.25 ",
            "rho_l",
            "q quit",
        ] {
            assert!(text.contains(words), "no `{words}` in\n{text}");
        }
        let reception = text.lines().find(|line| line.contains("\u{2502}visibilities ")).unwrap();
        let words: Vec<&str> =
            reception.trim_end_matches('\u{2502}').split_whitespace().rev().take(4).collect();
        assert_eq!(words, ["6", "0", "5", "1,234"], "{text}");
        // The curve is drawn with Braille dots.
        assert!(text.chars().filter(|c| ('\u{2801}'..='\u{28ff}').contains(c)).count() > 20, "{text}");
        assert!(!text.contains('\u{1b}'));
    }

    #[test]
    fn absent_panels_are_left_out() {
        // Any size and an empty status can be drawn.
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
        let mut disconnected = running();
        disconnected.disconnected_because = Some("refused".into());
        assert!(drawn(&disconnected, 120, 30).contains("not connected (refused); showing the last state"));
        let mut failed = running();
        failed.status["phase"] = json!("failed");
        failed.status["ledger"]["unaccounted"] = json!(null);
        let text = drawn(&failed, 100, 46);
        assert!(text.contains("balance unknown: the run failed") && !text.contains("balanced"), "{text}");

        let mut unbalanced = running();
        unbalanced.status["phase"] = json!("ended");
        unbalanced.status["ledger"]["unaccounted"] = json!(17);
        unbalanced.figures = json!({"spectra": {"cl_map": [0.0, 1e4, 1e5, 1e3]}});
        let text = drawn(&unbalanced, 100, 46);
        assert!(text.contains("imbalance: 17 unaccounted") && text.contains("C_l of the map"), "{text}");
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
            // All digits, or a rounded number with a prefix.
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
                assert!(map.contains(" 98.8T ") && map.contains("1.500e6"), "{width}:\n{text}");
            }
            assert!(text.contains("running \u{b7} 1:02:05"), "{width}:\n{text}");
            assert!(text.contains("residual 1.0e-3 of 1e-6"), "{width}:\n{text}");
        }
    }

    #[test]
    fn a_low_terminal_shows_the_busiest_stages_and_whole_rows() {
        let mut screen = running();
        let stages =
            [("observe", 0.0, true), ("integrate", 0.3, false), ("store", 0.1, false), ("send", 0.2, false)];
        let stage = |(name, busy, ended): (&str, f64, bool)| {
            let mut stage = screen.status["stages"][0].clone();
            (stage["name"], stage["busy"], stage["ended"]) = (json!(name), json!(busy), json!(ended));
            stage
        };
        let stages: Vec<Value> = (0..2).flat_map(|_| stages).map(stage).collect();
        screen.status["stages"] = json!(stages);
        let channel = screen.status["channels"][0].clone();
        screen.status["channels"] = json!(vec![channel; 5]);
        for width in [60, 80] {
            let text = drawn(&screen, width, 24);
            let rows = |words: &str| text.lines().filter(|line| line.contains(words)).count();
            assert_eq!([rows("observe"), rows("integrate"), rows("   3.000 ")], [0, 2, 5], "{text}");
            assert!(text.contains("the 2 busiest of 8") && text.contains("residual 1.0e-3"), "{text}");
            assert!(text.contains("89  flagged") && text.contains("q quit"), "{text}");
        }
        // A long ledger says how much of it is missing.
        let reasons: serde_json::Map<String, Value> =
            (0..30).map(|k| (format!("reason {k:02}"), json!(k))).collect();
        screen.status["ledger"]["flagged"] = json!(reasons);
        // 34 lines, of which 11 have room, the last for this.
        assert!(drawn(&screen, 80, 24).contains("and 24 more lines"));
        assert!(drawn(&screen, 80, 80).contains("29  flagged: reason 29"));
    }
}
