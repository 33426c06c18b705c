//! Reports of what scenes lack for signals, arrivals and departures.

use gump_eval::{Note, NoteCount, Notes};
use serde_json::{Value, json};

use crate::run::Run;

/// Adds the notes, if there are any, to the report and prints one line for each.
pub(crate) fn report(run: &mut Run, notes: &Notes, n_scenes: usize) -> anyhow::Result<()> {
    if notes.is_empty() {
        return Ok(());
    }
    let rows: Vec<Value> = notes.iter().map(|(note, count)| row(note, count)).collect();
    run.result_hidden("notes", rows)?;
    for (note, count) in notes.iter() {
        run.print(&line(note, count, n_scenes));
    }
    Ok(())
}

fn row(note: Note, count: NoteCount) -> Value {
    json!({
        "note": note.name(),
        "cases": count.cases,
        "scenes": count.scenes,
        "meaning": note.meaning(),
    })
}

fn line(note: Note, count: NoteCount, n_scenes: usize) -> String {
    let meaning = note.meaning();
    match n_scenes {
        1 => format!("note: {} {meaning}", count.cases),
        n => format!(
            "note: {} (in {} of {n} scenes) {meaning}",
            count.cases, count.scenes
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_has_the_number_of_cases_and_of_scenes() {
        let count = NoteCount {
            cases: 5,
            scenes: 2,
        };
        let many = line(Note::UnmappedLight, count, 40);
        assert!(
            many.starts_with("note: 5 (in 2 of 40 scenes) lights of lanes"),
            "{many}"
        );
        let one = line(Note::UnmappedLight, count, 1);
        assert!(one.starts_with("note: 5 lights of lanes"), "{one}");
    }
}
