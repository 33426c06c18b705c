//! JSON results as aligned text.
//!
//! Objects become `name  value` lines with dotted names; a list of objects becomes a table with one
//! row each, its columns in order of first appearance; of long tables only the start is shown,
//! `report.json` has all. A table that is too wide is transposed if that fits; otherwise columns
//! are left out, with a note.

use serde_json::Value;

/// The text of `results`, every line ended, in tables of at most `width` columns.
pub(crate) fn text(results: &Value, width: usize) -> String {
    let mut pairs = Vec::new();
    let mut tables = Vec::new();
    walk("", results, &mut pairs, &mut tables);
    let pairs: Rows = pairs
        .into_iter()
        .map(|(name, value)| vec![name, cell(value)])
        .collect();
    let mut text = aligned(&pairs);
    for (name, rows) in tables {
        let shown = rows.len().min(MAX_ROWS + 1);
        let (fitted, hidden) = fitted(rows[..shown].to_vec(), width);
        text.push_str(&format!("\n{name}\n{}", aligned(&fitted)));
        if rows.len() > shown {
            text.push_str(&format!("... and {} more\n", rows.len() - shown));
        }
        if !hidden.is_empty() {
            let note = format!(
                "... and {} more columns, in report.json and here with --wide: {}",
                hidden.len(),
                hidden.join(", ")
            );
            text.push_str(&wrapped(&note, width));
        }
    }
    text
}

/// Rows of a table shown on a terminal: about a screen. Chosen by hand.
const MAX_ROWS: usize = 50;

type Rows = Vec<Vec<String>>;

fn walk<'v>(
    name: &str,
    value: &'v Value,
    pairs: &mut Vec<(String, &'v Value)>,
    tables: &mut Vec<(String, Rows)>,
) {
    match value {
        Value::Object(fields) => {
            for (key, value) in fields {
                let name = match name {
                    "" => key.clone(),
                    name => format!("{name}.{key}"),
                };
                walk(&name, value, pairs, tables);
            }
        }
        Value::Array(rows) if rows.iter().any(Value::is_object) => {
            tables.push((name.into(), table(rows)));
        }
        value => pairs.push((name.into(), value)),
    }
}

/// Objects as a table: the names of its columns in order of first appearance, and for each row a
/// value per column where it has one. Nested keys get dots, lists of objects are left out.
pub(crate) fn flattened(rows: &[Value]) -> (Vec<String>, Vec<Vec<Option<&Value>>>) {
    let flat = rows.iter().map(|row| {
        let (mut pairs, mut nested) = (Vec::new(), Vec::new());
        walk("", row, &mut pairs, &mut nested);
        pairs
    });
    let flat: Vec<Vec<(String, &Value)>> = flat.collect();
    let mut columns: Vec<String> = Vec::new();
    for (column, _) in flat.iter().flatten() {
        if !columns.contains(column) {
            columns.push(column.clone());
        }
    }
    let body = flat.iter().map(|row| {
        let value = |column| row.iter().find(|(name, _)| name == column);
        columns
            .iter()
            .map(|column| value(column).map(|(_, value)| *value))
            .collect()
    });
    let body = body.collect();
    (columns, body)
}

fn table(rows: &[Value]) -> Rows {
    let (columns, body) = flattened(rows);
    let body = body.iter().map(|row| {
        let cells = row.iter().map(|value| value.map_or("-".into(), cell));
        cells.collect()
    });
    std::iter::once(columns).chain(body).collect()
}

fn cell(value: &Value) -> String {
    match value {
        Value::Null => "-".into(),
        Value::String(text) => text.clone(),
        Value::Number(number) => match number.as_f64() {
            Some(x) if number.is_f64() => decimal(x),
            _ => number.to_string(),
        },
        Value::Array(values) if values.is_empty() => "-".into(),
        Value::Array(values) => values.iter().map(cell).collect::<Vec<_>>().join(" "),
        value => value.to_string(),
    }
}

/// Four significant digits, never an exponent for everyday numbers.
pub(crate) fn decimal(x: f64) -> String {
    let magnitude = x.abs();
    if x == 0.0 {
        "0".into()
    } else if magnitude >= 1000.0 {
        format!("{x:.0}")
    } else if magnitude >= 1e-4 {
        let digits = (3 - magnitude.log10().floor() as i32).max(0) as usize;
        format!("{x:.digits$}")
    } else {
        format!("{x:.1e}")
    }
}

/// Text in lines of at most `width` columns, where its words allow that.
fn wrapped(text: &str, width: usize) -> String {
    let (mut wrapped, mut column) = (String::new(), 0);
    for word in text.split(' ') {
        let n = word.chars().count();
        if column > 0 && column + 1 + n > width {
            wrapped.push_str("\n... ");
            column = 4 + n;
        } else {
            wrapped.push_str(if column > 0 { " " } else { "" });
            column += usize::from(column > 0) + n;
        }
        wrapped.push_str(word);
    }
    wrapped.push('\n');
    wrapped
}

/// The table in a form that fits, and the names of its columns or rows that had to go for that.
fn fitted(rows: Rows, width: usize) -> (Rows, Vec<String>) {
    if width_of(&rows) <= width {
        return (rows, Vec::new());
    }
    let joined = with_intervals(rows);
    if width_of(&joined) <= width {
        return (joined, Vec::new());
    }
    let turned = transposed(&joined);
    // A table with more worlds than numbers is no better on its side.
    let mut best = match width_of(&turned) < width_of(&joined) {
        true => turned,
        false => joined,
    };
    for name in best.iter_mut().take(1).flatten() {
        *name = shortened(name);
    }
    let names = best.first().cloned().unwrap_or_default();
    let mut kept = names.len();
    while kept > 2 && width_of(&best) > width {
        kept -= 1;
        for row in &mut best {
            row.truncate(kept);
        }
    }
    (best, names[kept..].to_vec())
}

/// Columns `X`, `X low` and `X high` as one.
fn with_intervals(rows: Rows) -> Rows {
    let Some(names) = rows.first().cloned() else {
        return rows;
    };
    let find = |name: String| names.iter().position(|other| *other == name);
    let ends: Vec<Option<(usize, usize)>> = names
        .iter()
        .map(|name| find(format!("{name} low")).zip(find(format!("{name} high"))))
        .collect();
    let mut gone = vec![false; names.len()];
    for (low, high) in ends.iter().flatten() {
        (gone[*low], gone[*high]) = (true, true);
    }
    let row = |(i, row): (usize, &Vec<String>)| {
        let kept = (0..row.len()).filter(|column| !gone[*column]);
        let cells = kept.map(|column| match ends[column] {
            Some((low, high)) if i > 0 && row[low] != "-" => {
                format!("{} [{}, {}]", row[column], row[low], row[high])
            }
            _ => row[column].clone(),
        });
        cells.collect()
    };
    rows.iter().enumerate().map(row).collect()
}

/// Rows as columns.
fn transposed(rows: &Rows) -> Rows {
    let n_columns = rows.first().map_or(0, Vec::len);
    let column = |i: usize| rows.iter().map(|row| row[i].clone()).collect();
    (0..n_columns).map(column).collect()
}

/// The end of a long name, which distinguishes files of one folder.
fn shortened(name: &str) -> String {
    let n = name.chars().count();
    match n > LONGEST_NAME {
        true => format!(
            "\u{2026}{}",
            name.chars().skip(n - LONGEST_NAME + 1).collect::<String>()
        ),
        false => name.into(),
    }
}

/// Characters of a column's name where there is little room. Chosen by eye.
const LONGEST_NAME: usize = 24;

fn width_of(rows: &Rows) -> usize {
    let lines = aligned(rows);
    lines
        .lines()
        .map(|line| line.chars().count())
        .max()
        .unwrap_or(0)
}

/// First column to the left, numbers to the right.
fn aligned(rows: &[Vec<String>]) -> String {
    let n_columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let widths: Vec<usize> = (0..n_columns)
        .map(|column| {
            let lengths = rows.iter().filter_map(|row| row.get(column));
            lengths.map(|cell| cell.chars().count()).max().unwrap_or(0)
        })
        .collect();
    // A lone column of values reads best at the left; columns of numbers at the right.
    let right = n_columns > 2;
    let mut text = String::new();
    for row in rows {
        let mut line = String::new();
        for (column, (cell, width)) in row.iter().zip(&widths).enumerate() {
            if column > 0 {
                line.push_str("  ");
            }
            line.push_str(&if column > 0 && right {
                format!("{cell:>width$}")
            } else {
                format!("{cell:<width$}")
            });
        }
        text.push_str(line.trim_end());
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn pairs_and_tables() {
        let results = json!({
            "agents": {"vehicle": 12, "pedestrian": 3},
            "rate": 0.123456,
            "rows": [{"world": "idm", "ade": 1.5}, {"world": "log", "ade": 0.0, "note": "oracle"}],
        });
        let expected = "\
agents.vehicle     12
agents.pedestrian  3
rate               0.1235

rows
world    ade    note
idm    1.500       -
log        0  oracle
";
        assert_eq!(text(&results, 120), expected);
    }

    #[test]
    fn a_wide_table_lies_on_its_side() {
        let row = |world: &str| {
            let components = (0..12).map(|i| (format!("component_{i}"), json!(0.5)));
            let components: serde_json::Map<_, _> = components.collect();
            json!({"world": world, "metametric": 0.7, "components": components})
        };
        let results = json!({"rows": [row("log"), row("idm")]});
        let shown = text(&results, 120);
        assert!(
            shown.lines().all(|line| line.chars().count() <= 120),
            "{shown}"
        );
        assert!(
            shown.contains("\nmetametric               0.7000  0.7000\n"),
            "{shown}"
        );
        assert!(shown.contains("components.component_11"), "{shown}");
        let wide = text(&results, usize::MAX);
        assert!(
            wide.lines().any(|line| line.chars().count() > 120),
            "{wide}"
        );
    }

    #[test]
    fn intervals_are_one_column_where_room_is_scarce() {
        let line = |score: &str| json!({"score": score, "my world": 0.7, "my world low": 0.65, "my world high": 0.75});
        let results = json!({"intervals": [line("a"), line("b")]});
        let shown = text(&results, 36);
        let expected = "\nintervals\nscore  my world\na      0.7000 [0.6500, 0.7500]\n\
                        b      0.7000 [0.6500, 0.7500]\n";
        assert_eq!(shown, expected);
    }

    #[test]
    fn columns_that_fit_in_no_way_are_counted() {
        let rows: Vec<Value> = (0..9)
            .map(|i| json!({"name": format!("a world {i}"), "x": i, "y": i}))
            .collect();
        let shown = text(&json!({"rows": rows}), 12);
        assert!(
            shown
                .lines()
                .all(|line| line.starts_with("...") || line.chars().count() <= 14),
            "{shown}"
        );
        let note = shown.replace("\n... ", " ");
        let expected = "and 1 more columns, in report.json and here with --wide: y\n";
        assert!(note.contains(expected), "{shown}");
        assert_eq!(wrapped("one two three", 9), "one two\n... three\n");
    }

    #[test]
    fn decimals_have_four_digits() {
        let shown: Vec<_> = [0.0, 1.0, 0.012_345_6, 123.456, 98_765.4, 1e-7]
            .map(decimal)
            .into();
        assert_eq!(shown, ["0", "1.000", "0.01235", "123.5", "98765", "1.0e-7"]);
    }
}
