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

/// Where `--serve 8080` serves.
const ADDRESS: &str = "127.0.0.1:8080";

/// Interval between two looks at the server.
const LOOK_EVERY: Duration = Duration::from_millis(500);

/// Longest wait for a key.
const POLL: Duration = Duration::from_millis(100);

/// How long the end may take after a signal, or after the terminal has gone; and the code to exit with then, as after SIGHUP.
const END_WITHIN: Duration = Duration::from_secs(1);
const HUNG_UP: i32 = 129;

/// Width and height of a frame that is printed, characters; empty lines at its end are left out.
const PRINTED: (u16, u16) = (120, 50);

/// Show a running command in this terminal.
///
/// Shows what `run`, `replay` or `simulate` serves with `--serve`: stages with their queues, the ledger, reception, maps and
/// their correlation with the input. It only looks. q or Ctrl-C ends it, and the run goes on.
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

/// An address as `--serve` takes it, or as it prints it.
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
    let first = ServerSnapshot::of(&client, 0)?;
    let mut screen = Screen { address: client.address(), ..Screen::default() };
    first.show(&mut screen);
    if args.once {
        print_text(&printed(&screen))?;
        return Ok(Completion::Done);
    }
    if !std::io::stdout().is_terminal() {
        return Err(
            "standard output is no terminal; expected one, or --once for a frame of plain text".into()
        );
    }
    let interrupt = Interrupt::default();
    interrupt.arm_or_note();
    let (ask, asked) = channel();
    let (answer, answers) = channel();
    // It ends with the channels, or with the process: a server that does not answer holds up nothing.
    std::thread::spawn(move || poll(&client, &asked, &answer));
    end_with_terminal(&interrupt);
    let watched = {
        let mut terminal = Restored(ratatui::try_init()?);
        watch(&mut terminal.0, &mut screen, &interrupt, &ask, &answers)
    };
    watched?;
    Ok(interrupt.completion(interrupt.cancel().is_cancelled()))
}

/// Ends the process once its terminal is gone, or a signal has come and nothing has followed of it: waiting for a key may never end then.
fn end_with_terminal(interrupt: &Interrupt) {
    let cancel = interrupt.cancel().clone();
    std::thread::spawn(move || {
        while !cancel.is_cancelled() && std::io::stdout().is_terminal() {
            std::thread::sleep(POLL);
        }
        std::thread::sleep(END_WITHIN);
        std::process::exit(HUNG_UP);
    });
}

/// A terminal that is as it was before, once dropped.
struct Restored(ratatui::DefaultTerminal);

impl Drop for Restored {
    fn drop(&mut self) {
        // There is nobody to tell.
        let _ = ratatui::try_restore();
    }
}

/// The state of a run, as its server tells it at one time.
struct ServerSnapshot {
    status: Value,
    /// Of the channel at this place in the list.
    figures: Value,
}

impl ServerSnapshot {
    fn of(client: &Client, place: usize) -> Result<Self, ClientError> {
        let status = client.json("/api/status")?;
        let channel = &status["channels"][place]["channel"];
        let figures = match channel.as_u64() {
            Some(channel) => client.json(&format!("/api/figures/{channel}"))?,
            None => Value::Null,
        };
        Ok(Self { status, figures })
    }

    fn show(self, screen: &mut Screen) {
        let Self { status, figures } = self;
        *screen = Screen { status, figures, lost: None, ..std::mem::take(screen) };
    }
}

/// Looks at the server again and again, at the channel that was asked for last.
fn poll(client: &Client, asked: &Receiver<usize>, answer: &Sender<Result<ServerSnapshot, ClientError>>) {
    let mut place = 0;
    loop {
        match asked.recv_timeout(LOOK_EVERY) {
            Ok(wanted) => place = wanted,
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return,
        }
        if answer.send(ServerSnapshot::of(client, place)).is_err() {
            return;
        }
    }
}

/// Draws until a key or a signal ends it.
fn watch(
    terminal: &mut ratatui::DefaultTerminal,
    screen: &mut Screen,
    interrupt: &Interrupt,
    ask: &Sender<usize>,
    answers: &Receiver<Result<ServerSnapshot, ClientError>>,
) -> std::io::Result<()> {
    terminal.draw(|frame| screen.draw(frame))?;
    while !interrupt.cancel().is_cancelled() {
        let mut is_new = false;
        for answer in answers.try_iter() {
            is_new = true;
            match answer {
                Ok(look) => look.show(screen),
                Err(ClientError::Connection { source, .. }) => screen.lost = Some(source.to_string()),
                Err(error) => screen.lost = Some(error.to_string()),
            }
        }
        if event::poll(POLL)? {
            is_new = true;
            if let Event::Key(key) = event::read()? {
                match action(key) {
                    Action::Quit => return Ok(()),
                    Action::Channel(by) => {
                        let channels = screen.status["channels"].as_array().map_or(0, Vec::len);
                        screen.place = screen.place.saturating_add_signed(by).min(channels.saturating_sub(1));
                        // The thread has gone only if it panicked, which it has said.
                        let _ = ask.send(screen.place);
                    }
                    Action::Nothing => {}
                }
            }
        }
        if is_new {
            terminal.draw(|frame| screen.draw(frame))?;
        }
    }
    Ok(())
}

/// What a key does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Action {
    Quit,
    /// So many channels on.
    Channel(isize),
    Nothing,
}

fn action(key: KeyEvent) -> Action {
    if key.kind == KeyEventKind::Release {
        return Action::Nothing;
    }
    match key.code {
        KeyCode::Char('q') | KeyCode::Esc => Action::Quit,
        // A terminal that passes on all keys makes no signal of it.
        KeyCode::Char('c') if key.modifiers.contains(KeyModifiers::CONTROL) => Action::Quit,
        KeyCode::Left | KeyCode::Up => Action::Channel(-1),
        KeyCode::Right | KeyCode::Down => Action::Channel(1),
        _ => Action::Nothing,
    }
}

/// A frame as lines of text.
fn printed(screen: &Screen) -> String {
    let (width, height) = PRINTED;
    let Ok(mut terminal) = Terminal::new(TestBackend::new(width, height));
    let Ok(_) = terminal.draw(|frame| screen.draw(frame));
    let buffer = terminal.backend().buffer();
    let line = |y| (0..width).filter_map(|x| Some(buffer.cell((x, y))?.symbol())).collect::<String>();
    // The last line names keys.
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
