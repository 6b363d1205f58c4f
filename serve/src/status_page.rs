//! The state as plain HTML without scripts: for a text browser, a broken one, or a curious `curl`.

use std::fmt::Write;

use crate::board::Board;
use crate::views::JobState;

/// Events and workers listed.
const LISTED: usize = 20;

/// The page.
pub(crate) fn page(board: &Board, now: u64) -> String {
    let mut body = String::new();
    let snapshot = board.snapshot(0, now);
    // Writing to a string cannot fail.
    let _ = write_body(&mut body, &snapshot, now);
    format!(
        "<!doctype html><html lang=en><meta charset=utf-8><meta http-equiv=refresh content=5>\
         <meta name=viewport content=\"width=device-width\"><title>plat: status</title>\
         <style>body{{font:15px/1.5 system-ui,sans-serif;margin:2em auto;max-width:70em;padding:0 1em;color-scheme:light dark}}\
         table{{border-collapse:collapse}}td,th{{padding:.2em .8em .2em 0;text-align:left;font-variant-numeric:tabular-nums}}\
         th{{border-bottom:1px solid}}</style>\n{body}</html>\n"
    )
}

fn write_body(out: &mut String, snapshot: &crate::views::Snapshot<'_>, now: u64) -> std::fmt::Result {
    writeln!(out, "<h1>plat {}</h1>", snapshot.server.version)?;
    if let Some(coordinator) = &snapshot.server.coordinator {
        let answers = if coordinator.reachable { "answers" } else { "does not answer" };
        writeln!(out, "<p>Coordinator {} {answers}.", escaped(&coordinator.url))?;
    }
    if snapshot.jobs.is_empty() {
        writeln!(out, "<p>No job. <code>plat submit CAPTURE --coordinator URL</code> submits one.")?;
    } else {
        writeln!(
            out,
            "<h2>Jobs</h2><table><tr><th>job<th>name<th>state<th>blocks and tasks<th>splats<th>PSNR<th>left"
        )?;
    }
    for job in &snapshot.jobs {
        let counts = &job.counts;
        let all = job.blocks + job.evaluations + job.detections + job.objects;
        let state = match job.state {
            JobState::Running => "running",
            JobState::Paused => "paused",
            JobState::Done => "done",
            JobState::Incomplete => "incomplete: tasks failed",
            JobState::Cancelled => "cancelled",
        };
        let failed = counts.failed + counts.quarantined;
        let psnr = job.psnr.map_or("–".into(), |psnr| format!("{psnr:.2} dB"));
        let left = job.eta_seconds.map_or("–".into(), |[low, high]| format!("{} to {}", span(low), span(high)));
        let (id, name, splats) = (job.id, escaped(&job.name), job.splats);
        let (done, leased) = (counts.done, counts.leased);
        writeln!(
            out,
            "<tr><td>{id}<td>{name}<td>{state}<td>{done} of {all} done, {leased} running, {failed} failed<td>{splats}<td>{psnr}<td>{left}"
        )?;
    }
    writeln!(out, "</table>")?;
    if !snapshot.workers.is_empty() {
        writeln!(out, "<h2>Workers</h2><table><tr><th>worker<th>state<th>task<th>last heard")?;
        for worker in snapshot.workers.iter().take(LISTED) {
            let state = format!("{:?}", worker.state).to_lowercase();
            let task = worker.task.map_or("–".into(), |task| task.to_string());
            let heard = span(now.saturating_sub(worker.heard_unix_ms) as f64 / 1e3);
            writeln!(out, "<tr><td>{}<td>{state}<td>{task}<td>{heard} ago", escaped(&worker.name))?;
        }
        writeln!(out, "</table>")?;
    }
    writeln!(out, "<h2>Latest</h2><table>")?;
    for event in snapshot.events.iter().rev().take(LISTED) {
        let ago = span(now.saturating_sub(event.unix_ms) as f64 / 1e3);
        let task = event.task.map_or(String::new(), |task| format!("task {task}"));
        writeln!(out, "<tr><td>{ago} ago<td>{task}<td>{}<td>{}", escaped(&event.worker), escaped(&event.what))?;
    }
    writeln!(out, "</table><p><a href=\"/\">The dashboard</a> needs JavaScript.")
}

fn span(seconds: f64) -> String {
    match seconds {
        s if s < 120.0 => format!("{s:.0} s"),
        s if s < 7200.0 => format!("{:.0} min", s / 60.0),
        s => format!("{:.1} h", s / 3600.0),
    }
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{event, server};

    #[test]
    fn names_from_elsewhere_are_text() {
        let mut board = Board::new(server());
        assert!(page(&board, 0).contains("plat submit CAPTURE"));
        board.event(event("<script>alert(1)</script>"));
        let page = page(&board, 61_000);
        assert!(page.contains("&lt;script&gt;") && !page.contains("<script"), "{page}");
        assert!(page.contains("61 s ago"), "{page}");
    }
}
