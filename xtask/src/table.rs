//! JSON results as aligned text.
//!
//! Objects become `name  value` lines with dotted names; a list of objects becomes a table with
//! one row each, its columns in order of first appearance; of long tables only the start is shown,
//! `report.json` has all.

use serde_json::Value;

/// The text of `results`, every line ended.
pub(crate) fn text(results: &Value) -> String {
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
        text.push_str(&format!("\n{name}\n{}", aligned(&rows[..shown])));
        if rows.len() > shown {
            text.push_str(&format!("... and {} more\n", rows.len() - shown));
        }
    }
    text
}

/// Rows of a table shown on a terminal.
const MAX_ROWS: usize = 40;

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
        assert_eq!(text(&results), expected);
    }

    #[test]
    fn decimals_have_four_digits() {
        let shown: Vec<_> = [0.0, 1.0, 0.012_345_6, 123.456, 98_765.4, 1e-7]
            .map(decimal)
            .into();
        assert_eq!(shown, ["0", "1.000", "0.01235", "123.5", "98765", "1.0e-7"]);
    }
}
