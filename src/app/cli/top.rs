//! `lunarray top`: the page of a running command in a terminal.

use std::io::IsTerminal;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::Duration;

use clap::Args;
use ratatui::Terminal;
use ratatui::backend::TestBackend;
use ratatui::crossterm::event::{self, Event, KeyCode, KeyEvent, KeyEventKind, KeyModifiers};
use serde_json::Value;

use super::interrupt::Interrupt;
use super::output::{CommandResult, Completion, print_json_line, print_text};
use crate::serve::{Client, ClientError, Screen, ServeAddress};

/// Default address, that of `--serve 8080`.
const ADDRESS: &str = "127.0.0.1:8080";

/// Interval between two requests of the status.
const STATUS_EVERY: Duration = Duration::from_millis(500);

/// Time limit of a wait for a key, and interval of checks for the terminal.
const KEY_WAIT: Duration = Duration::from_millis(100);

/// Time limit for the end of the process after a signal, or after the terminal is gone.
const END_WITHIN: Duration = Duration::from_secs(1);
/// Exit code after that limit, as after SIGHUP.
const HANGUP_CODE: i32 = 129;

/// Width and height of a printed frame, characters; trailing empty lines are left out.
const PRINTED: (u16, u16) = (120, 50);

/// Show a running command in this terminal.
///
/// Shows what `run`, `replay` or `simulate` serves with `--serve`: stages with their queues, the ledger, reception, maps and
/// their correlation with the input. It is read-only. q or Ctrl-C ends it, and the run continues.
///
/// Example: lunarray top 8080
#[derive(Debug, Args)]
pub(super) struct TopArgs {
    /// Where the command serves: a port of this machine, or HOST:PORT.
    #[arg(value_name = "PORT|HOST:PORT", default_value = ADDRESS, value_parser = address)]
    address: ServeAddress,
    /// Print one frame as plain text, and end.
    #[arg(long)]
    once: bool,
    /// Print the status as one JSON object, as /api/status has it, and end.
    #[arg(long, conflicts_with = "once")]
    json: bool,
}

/// Parses an address in the form that `--serve` accepts or prints.
fn address(text: &str) -> Result<ServeAddress, String> {
    let bare = text.strip_prefix("http://").unwrap_or(text);
    bare.trim_end_matches('/').parse().map_err(|error: crate::serve::ServeError| error.to_string())
}

pub(super) fn execute(args: &TopArgs) -> CommandResult {
    let client = Client::new(args.address.clone());
    if args.json {
        print_json_line(&client.json("/api/status")?)?;
        return Ok(Completion::Done);
    }
    let first = ServerSnapshot::request(&client, 0)?;
    let mut screen = Screen { address: client.address(), ..Screen::default() };
    first.show(&mut screen);
    if args.once {
        print_text(&frame_text(&screen))?;
        return Ok(Completion::Done);
    }
    if !std::io::stdout().is_terminal() {
        return Err(
            "standard output is no terminal; expected one, or --once for a frame of plain text".into()
        );
    }
    let interrupt = Interrupt::default();
    interrupt.arm_or_note();
    let (request_sender, requests) = channel();
    let (reply_sender, replies) = channel();
    // The thread ends with the channels or the process, so that a server that does not respond delays nothing.
    std::thread::spawn(move || poll_server(&client, &requests, &reply_sender));
    end_with_terminal(&interrupt);
    let result = {
        let mut terminal = TerminalGuard(ratatui::try_init()?);
        show_until_quit(&mut terminal.0, &mut screen, &interrupt, &request_sender, &replies)
    };
    result?;
    Ok(interrupt.completion(interrupt.cancel().is_cancelled()))
}

/// Exits the process soon after the terminal is gone or a signal has arrived, as waiting for a key may block forever.
fn end_with_terminal(interrupt: &Interrupt) {
    let cancel = interrupt.cancel().clone();
    std::thread::spawn(move || {
        while !cancel.is_cancelled() && std::io::stdout().is_terminal() {
            std::thread::sleep(KEY_WAIT);
        }
        std::thread::sleep(END_WITHIN);
        std::process::exit(HANGUP_CODE);
    });
}

/// Restores the terminal when dropped.
struct TerminalGuard(ratatui::DefaultTerminal);

impl Drop for TerminalGuard {
    fn drop(&mut self) {
        let _ = ratatui::try_restore();
    }
}

/// Replies of a server.
struct ServerSnapshot {
    status: Value,
    /// `/api/figures` of the selected channel; null without channels.
    figures: Value,
}

impl ServerSnapshot {
    /// Requests the status, and the figures of the channel at `channel_index` in it.
    fn request(client: &Client, channel_index: usize) -> Result<Self, ClientError> {
        let status = client.json("/api/status")?;
        let channel = &status["channels"][channel_index]["channel"];
        let figures = match channel.as_u64() {
            Some(channel) => client.json(&format!("/api/figures/{channel}"))?,
            None => Value::Null,
        };
        Ok(Self { status, figures })
    }

    fn show(self, screen: &mut Screen) {
        let Self { status, figures } = self;
        *screen = Screen { status, figures, disconnected_because: None, ..std::mem::take(screen) };
    }
}

/// Polls the server with the channel index that was requested last.
fn poll_server(
    client: &Client,
    requests: &Receiver<usize>,
    replies: &Sender<Result<ServerSnapshot, ClientError>>,
) {
    let mut channel_index = 0;
    loop {
        match requests.recv_timeout(STATUS_EVERY) {
            Ok(requested) => channel_index = requested,
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return,
        }
        if replies.send(ServerSnapshot::request(client, channel_index)).is_err() {
            return;
        }
    }
}

/// Draws the screen until a key or a signal ends it.
fn show_until_quit(
    terminal: &mut ratatui::DefaultTerminal,
    screen: &mut Screen,
    interrupt: &Interrupt,
    requests: &Sender<usize>,
    replies: &Receiver<Result<ServerSnapshot, ClientError>>,
) -> std::io::Result<()> {
    terminal.draw(|frame| screen.draw(frame))?;
    while !interrupt.cancel().is_cancelled() {
        let mut is_changed = false;
        for reply in replies.try_iter() {
            is_changed = true;
            match reply {
                Ok(snapshot) => snapshot.show(screen),
                Err(ClientError::Connection { source, .. }) => {
                    screen.disconnected_because = Some(source.to_string());
                }
                Err(error) => screen.disconnected_because = Some(error.to_string()),
            }
        }
        if event::poll(KEY_WAIT)? {
            is_changed = true;
            if let Event::Key(key) = event::read()? {
                match action(key) {
                    Action::Quit => return Ok(()),
                    Action::Channel(step) => {
                        let last = screen.status["channels"].as_array().map_or(0, Vec::len).saturating_sub(1);
                        screen.channel_index = screen.channel_index.saturating_add_signed(step).min(last);
                        // This fails only if the thread has panicked, which has been reported.
                        let _ = requests.send(screen.channel_index);
                    }
                    Action::Nothing => {}
                }
            }
        }
        if is_changed {
            terminal.draw(|frame| screen.draw(frame))?;
        }
    }
    Ok(())
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Action {
    Quit,
    /// Move the selection by this many channels.
    Channel(isize),
    Nothing,
}

fn action(key: KeyEvent) -> Action {
    if key.kind == KeyEventKind::Release {
        return Action::Nothing;
    }
    match key.code {
        KeyCode::Char('q') | KeyCode::Esc => Action::Quit,
        // In raw mode, Ctrl-C arrives as a key and not as SIGINT.
        KeyCode::Char('c') if key.modifiers.contains(KeyModifiers::CONTROL) => Action::Quit,
        KeyCode::Left | KeyCode::Up => Action::Channel(-1),
        KeyCode::Right | KeyCode::Down => Action::Channel(1),
        _ => Action::Nothing,
    }
}

/// A frame as lines of text.
fn frame_text(screen: &Screen) -> String {
    let (width, height) = PRINTED;
    // A `TestBackend` draws into memory; its errors are `Infallible`.
    let Ok(mut terminal) = Terminal::new(TestBackend::new(width, height));
    let Ok(_) = terminal.draw(|frame| screen.draw(frame));
    let buffer = terminal.backend().buffer();
    let line = |y| (0..width).filter_map(|x| Some(buffer.cell((x, y))?.symbol())).collect::<String>();
    // The last line lists the keys, which have no effect here.
    let lines: Vec<String> = (0..height - 1).map(|y| line(y).trim_end().to_owned()).collect();
    lines.join("\n").trim_end().to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_and_addresses_are_read() {
        let key = |code, modifiers| action(KeyEvent::new(code, modifiers));
        assert_eq!(key(KeyCode::Char('q'), KeyModifiers::NONE), Action::Quit);
        assert_eq!(key(KeyCode::Char('c'), KeyModifiers::CONTROL), Action::Quit);
        assert_eq!(key(KeyCode::Char('c'), KeyModifiers::NONE), Action::Nothing);
        assert_eq!(key(KeyCode::Right, KeyModifiers::NONE), Action::Channel(1));
        for text in ["8080", "127.0.0.1:8080", "http://127.0.0.1:8080/"] {
            assert_eq!(address(text).unwrap().to_string(), ADDRESS);
        }
        assert!(address("https://host:1").is_err());
    }
}
