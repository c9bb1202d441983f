//! Tables as text (CSV and alike): a line of column names, then lines of cells. Columns are found by name, and faults name their line.

use std::borrow::Cow;

use thiserror::Error;

use crate::units::{echo, shortened};

/// Most columns of a table.
const COLUMNS_MAX: usize = 10_000;

/// Longest list of names that a message repeats, characters.
const NAMES_CHARS_MAX: usize = 200;

/// What is wrong in a table, and where.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error("line {line}: found {found}; expected {expected}")]
pub struct TableFault {
    /// Line, counted from 1.
    pub line: usize,
    /// What was found.
    pub found: String,
    /// What was expected.
    pub expected: String,
}

/// What separates the cells of a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Separator {
    /// This character.
    Sign(char),
    /// Any number of blanks.
    Blanks,
    /// Any number of commas and blanks.
    CommasOrBlanks,
}

impl Separator {
    /// That of a line: tab, semicolon, bar or comma, the first of them that occurs, or blanks.
    #[must_use]
    pub fn of(line: &str) -> Self {
        ['\t', ';', '|', ','].into_iter().find(|sign| line.contains(*sign)).map_or(Self::Blanks, Self::Sign)
    }

    fn is(self, c: char) -> bool {
        match self {
            Self::Sign(sign) => c == sign,
            Self::Blanks => c.is_whitespace(),
            Self::CommasOrBlanks => c == ',' || c.is_whitespace(),
        }
    }

    /// The cells of a line, without blanks around them. A cell in quotes may contain the separator, and a doubled quote means a quote; a
    /// quote within a cell, as for arcseconds, is literal.
    pub fn cells(self, line: &str) -> impl Iterator<Item = Cow<'_, str>> {
        let mut rest = Some(line);
        std::iter::from_fn(move || {
            loop {
                let (cell, quotes, after) = self.first_cell(rest?);
                rest = after;
                if quotes != Quotes::None || !cell.is_empty() || matches!(self, Self::Sign(_)) {
                    return Some(cell);
                }
            }
        })
    }

    /// The first cell, its quotes, and what is behind its separator.
    fn first_cell(self, text: &str) -> (Cow<'_, str>, Quotes, Option<&str>) {
        let text = text.trim_start_matches(|c: char| c.is_whitespace() && !self.is(c));
        let Some(quoted) = text.strip_prefix('"') else {
            let (cell, rest) = text.split_at(text.find(|c| self.is(c)).unwrap_or(text.len()));
            return (Cow::Borrowed(cell.trim_end()), Quotes::None, behind_first(rest));
        };
        let (mut cell, mut is_within, mut letters) = (String::new(), true, quoted.char_indices().peekable());
        while let Some((at, c)) = letters.next() {
            match c {
                '"' if is_within && letters.peek().is_some_and(|(_, next)| *next == '"') => {
                    letters.next();
                    cell.push('"');
                }
                '"' if is_within => is_within = false,
                c if !is_within && self.is(c) => {
                    return (Cow::Owned(cell.trim().to_owned()), Quotes::Closed, behind_first(&quoted[at..]));
                }
                c => cell.push(c),
            }
        }
        (Cow::Owned(cell.trim().to_owned()), if is_within { Quotes::Open } else { Quotes::Closed }, None)
    }

    /// That every quote of a line of this number is closed.
    ///
    /// # Errors
    /// A quote that is not.
    pub fn require_closed(self, line: usize, text: &str) -> Result<(), TableFault> {
        let mut rest = text.contains('"').then_some(text);
        while let Some(text) = rest {
            let (_, quotes, after) = self.first_cell(text);
            if quotes == Quotes::Open {
                let (found, expected) = ("a quote that is not closed", "its end on the same line");
                return Err(TableFault { line, found: found.to_owned(), expected: expected.to_owned() });
            }
            rest = after;
        }
        Ok(())
    }

    /// A finite number; with semicolons between cells, a comma may be the decimal point.
    #[must_use]
    pub fn number(self, cell: &str) -> Option<f64> {
        let number = match self {
            Self::Sign(';') => cell.replace(',', ".").parse(),
            _ => cell.parse(),
        };
        number.ok().filter(|value: &f64| value.is_finite())
    }
}

/// Quotes around a cell.
#[derive(Clone, Copy, PartialEq)]
enum Quotes {
    None,
    Closed,
    /// Up to the end of the line.
    Open,
}

/// What is behind the first character.
fn behind_first(text: &str) -> Option<&str> {
    let mut letters = text.chars();
    letters.next().map(|_| letters.as_str())
}

/// Lines with their numbers, from 1, without a byte order mark and those [`without_cells`].
pub fn numbered_lines(text: &str) -> impl Iterator<Item = (usize, &str)> {
    (1..).zip(without_mark(text).lines()).filter(|(_, line)| !without_cells(line))
}

/// A text without the byte order mark at its beginning.
#[must_use]
pub fn without_mark(text: &str) -> &str {
    text.strip_prefix('\u{feff}').unwrap_or(text)
}

/// Whether a line is a comment (`#`), or its cells, between commas or blanks, are all empty.
#[must_use]
pub fn without_cells(line: &str) -> bool {
    is_comment(line) || Separator::CommasOrBlanks.cells(line).all(|cell| cell.is_empty())
}

/// Whether a line is a comment (`#`).
#[must_use]
pub fn is_comment(line: &str) -> bool {
    line.trim_start().starts_with('#')
}

/// Names of the columns of a table.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Columns {
    /// Names in order.
    pub names: Vec<String>,
    /// What separates cells.
    pub separator: Separator,
    /// Number of the line of names.
    pub line: usize,
}

impl Columns {
    /// Reads the line of names, of this number.
    ///
    /// # Errors
    /// A line of too many names, or with a quote that is not closed.
    pub fn new(line: usize, names: &str, separator: Separator) -> Result<Self, TableFault> {
        separator.require_closed(line, names)?;
        let names: Vec<String> = separator.cells(names).take(COLUMNS_MAX + 1).map(Cow::into_owned).collect();
        if names.len() > COLUMNS_MAX {
            let found = format!("more than {COLUMNS_MAX} columns");
            return Err(TableFault { line, found, expected: "fewer".to_owned() });
        }
        Ok(Self { names, separator, line })
    }

    /// The place of the column of this very name, if there is one.
    ///
    /// # Errors
    /// Several of this name.
    pub fn place_of_name(&self, name: &str) -> Result<Option<usize>, TableFault> {
        let mut places = (0..self.names.len()).filter(|place| self.names[*place] == name);
        let place = places.next();
        match places.next() {
            Some(_) => Err(self.fault(format!("several columns {:?}", echo(name)), "one of each name")),
            None => Ok(place),
        }
    }

    /// The place of a column, if there is one of this name or of one that may mean the same.
    ///
    /// # Errors
    /// Several of this name; or none, but one whose first word is the same in capitals or small letters, as in another unit.
    pub fn place(&self, name: &str) -> Result<Option<usize>, TableFault> {
        let word = |name: &str| name.split(|c: char| !c.is_alphanumeric()).next().map(str::to_lowercase);
        let place = self.place_of_name(name)?;
        match self.names.iter().find(|other| place.is_none() && word(other) == word(name)) {
            Some(other) => Err(self.fault(
                format!("the column {:?}", echo(other)),
                &format!("its values as {name}, or another name if they mean something else"),
            )),
            None => Ok(place),
        }
    }

    fn fault(&self, found: String, expected: &str) -> TableFault {
        TableFault { line: self.line, found, expected: expected.to_owned() }
    }

    /// The places of columns that a table has to have.
    ///
    /// # Errors
    /// As [`Columns::place`], or [`Columns::unlike`] what is expected.
    pub fn places<const N: usize>(&self, names: [&str; N], expected: &str) -> Result<[usize; N], TableFault> {
        let mut places = [0; N];
        for (place, name) in places.iter_mut().zip(names) {
            *place = self.place(name)?.ok_or_else(|| self.unlike(expected))?;
        }
        Ok(places)
    }

    /// That these are not the expected columns.
    #[must_use]
    pub fn unlike(&self, expected: &str) -> TableFault {
        let names = shortened(&self.names.join(", "), NAMES_CHARS_MAX);
        self.fault(format!("the columns {names:?}"), expected)
    }

    /// The cells of a line of this number.
    ///
    /// # Errors
    /// More cells than columns (empty ones do not count), or a quote that is not closed.
    pub fn row<'a>(&'a self, line: usize, text: &'a str) -> Result<Row<'a>, TableFault> {
        self.separator.require_closed(line, text)?;
        let mut rest = self.separator.cells(text);
        let cells: Vec<_> = rest.by_ref().take(self.names.len()).collect();
        let beyond = rest.enumerate().filter(|(_, cell)| !cell.is_empty()).last();
        if let Some((last, _)) = beyond {
            let found = format!("{} cells", cells.len() + last + 1);
            return Err(TableFault { line, found, expected: format!("{}, one a column", self.names.len()) });
        }
        Ok(Row { columns: self, line, cells })
    }

    /// One cell of a line; empty where the line has ended.
    #[must_use]
    pub fn cell(&self, text: &str, place: usize) -> String {
        self.separator.cells(text).nth(place).map_or_else(String::new, Cow::into_owned)
    }
}

/// The cells of a line.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Row<'a> {
    columns: &'a Columns,
    /// Number of the line, from 1.
    pub line: usize,
    cells: Vec<Cow<'a, str>>,
}

impl Row<'_> {
    /// The cell of a column; empty where the line has ended.
    #[must_use]
    pub fn cell(&self, place: usize) -> &str {
        self.cells.get(place).map_or("", |cell| cell)
    }

    /// The finite number of a column, which is as `expected`.
    ///
    /// # Errors
    /// A cell that is no such number.
    pub fn number(
        &self,
        place: usize,
        is_good: impl Fn(f64) -> bool,
        expected: &str,
    ) -> Result<f64, TableFault> {
        let value = self.columns.separator.number(self.cell(place)).filter(|value| is_good(*value));
        value.ok_or_else(|| self.fault(place, expected))
    }

    /// That a cell is not what is expected.
    #[must_use]
    pub fn fault(&self, place: usize, expected: &str) -> TableFault {
        let name = self.columns.names.get(place).map_or("", String::as_str);
        self.fault_of(format!("{:?} as {}", echo(self.cell(place)), echo(name)), expected)
    }

    /// That something in the line is not what is expected.
    #[must_use]
    pub fn fault_of(&self, found: String, expected: &str) -> TableFault {
        TableFault { line: self.line, found, expected: expected.to_owned() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_are_between_separators_and_may_be_quoted() {
        let comma = Separator::Sign(',');
        for (separator, line, expected) in [
            (comma, "a, b ,,c", &["a", "b", "", "c"][..]),
            (comma, "", &[""]),
            (comma, " \"a,b\" ,\"say \"\"c\"\"\",12'3\"", &["a,b", "say \"c\"", "12'3\""]),
            (comma, "\"open, to the end", &["open, to the end"]),
            (Separator::of("a\tb,c"), "a\tb,c\t", &["a", "b,c", ""]),
            (Separator::of("a b"), "  \"Cas A\"  23  \"\"", &["Cas A", "23", ""]),
            (Separator::CommasOrBlanks, "1, 2.5\t3,,4 ", &["1", "2.5", "3", "4"]),
        ] {
            assert_eq!(separator.cells(line).collect::<Vec<_>>(), expected, "{line}");
        }
        assert_eq!(Separator::Sign(';').number("1,5"), Some(1.5));
        assert_eq!((comma.number("1,5"), comma.number("inf"), comma.number("")), (None, None, None));
    }

    #[test]
    fn columns_are_found_by_name_and_unit() {
        let columns = |names| Columns::new(3, names, Separator::Sign(',')).unwrap();
        let found = columns("b_m, a_deg,,c_rad");
        assert_eq!(found.places(["a_deg", "b_m"], "both"), Ok([1, 0]));
        assert_eq!(found.place("d_m"), Ok(None));
        let told = |fault: TableFault| fault.to_string();
        for (fault, expected) in [
            (
                found.places(["d"], "a column d").unwrap_err(),
                "line 3: found the columns \"b_m, a_deg, , c_rad\"; expected a column d",
            ),
            (
                found.place("c_deg").unwrap_err(),
                "line 3: found the column \"c_rad\"; expected its values as c_deg, or another name if they mean something else",
            ),
            (
                columns("a,a").place("a").unwrap_err(),
                "line 3: found several columns \"a\"; expected one of each name",
            ),
            (found.row(4, "1,2,3,4,,5,").unwrap_err(), "line 4: found 6 cells; expected 4, one a column"),
            (
                found.row(4, "1,x").unwrap().number(1, |_| true, "a number").unwrap_err(),
                "line 4: found \"x\" as a_deg; expected a number",
            ),
            (
                found.row(4, "1").unwrap().number(3, |_| true, "a number").unwrap_err(),
                "line 4: found \"\" as c_rad; expected a number",
            ),
        ] {
            assert_eq!(told(fault), expected);
        }
        let row = found.row(4, "1,2,3,4,,").unwrap();
        assert_eq!((row.cell(3), row.number(0, |value| value > 0.0, "above 0")), ("4", Ok(1.0)));
        assert!(row.number(0, |value| value > 1.0, "above 1").is_err());
    }

    #[test]
    fn long_lines_of_names_take_no_memory() {
        let fault = Columns::new(1, &",".repeat(1_000_000), Separator::Sign(',')).unwrap_err();
        assert_eq!(fault.to_string(), "line 1: found more than 10000 columns; expected fewer");
        let long = Columns::new(1, &"x".repeat(1_000_000), Separator::Sign(',')).unwrap();
        assert!(long.unlike("a").to_string().len() < 300);
    }

    #[test]
    fn blank_lines_and_comments_are_no_rows() {
        let lines: Vec<_> =
            numbered_lines("\u{feff}# a\n\nb\n  # c\r\n d\n,, ,\r\n\"\", \n,\"\u{feff}\"\n").collect();
        assert_eq!(lines, [(3, "b"), (5, " d"), (8, ",\"\u{feff}\"")]);
        assert_eq!(numbered_lines("\u{feff}a,b").collect::<Vec<_>>(), [(1, "a,b")]);
    }

    #[test]
    fn columns_that_may_mean_the_wanted_one_are_refused() {
        let columns = |names: &str| Columns::new(2, names, Separator::Sign(',')).unwrap();
        for other in ["height", "Height_m", "height_KM", "height_ft", "height (m)", "HEIGHT[m]", "height-m"] {
            let told = columns(&format!("a,{other}")).place("height_m").unwrap_err().to_string();
            assert!(told.starts_with(&format!(
                "line 2: found the column {other:?}; expected its values as height_m"
            )));
        }
        assert_eq!(columns("heights,above_height_m,,(m)").place("height_m"), Ok(None));
        assert_eq!(columns("height_km,height_m").place("height_m"), Ok(Some(1)));
        assert_eq!(columns("gain_db").place_of_name("gain"), Ok(None));
    }

    #[test]
    fn quotes_are_closed_on_their_line() {
        let comma = Separator::Sign(',');
        let columns = Columns::new(1, "\"a\",b", comma).unwrap();
        let told = "line 7: found a quote that is not closed; expected its end on the same line";
        for text in ["1,\"2", "\"1,2", "\"1\"\",2", "\""] {
            assert_eq!(columns.row(7, text).unwrap_err().to_string(), told, "{text}");
            assert_eq!(Columns::new(7, text, comma).unwrap_err().to_string(), told, "{text}");
        }
        for text in ["\"1\",2", "12'3\",\"2\"", "\"\"\"\",\"\""] {
            assert_eq!(columns.row(7, text).err(), None, "{text}");
        }
    }
}
