// Files to take away, with size and hash.
import type { Download } from '../api';
import { bytes } from '../format';
import { job, server } from '../live';
import { Command, Empty, Panel, useGet, Waiting } from '../widgets/boundary';

export function Downloads() {
  const asked = useGet<{ files: Download[] }>('/api/downloads', job.value?.counts.done, 0);
  if (!asked.value) return <Waiting error={asked.error} what="the list of files" />;
  const { files } = asked.value;
  return (
    <Panel title="Downloads" aside={<span class="num">{files.length} files · {bytes(files.reduce((n, f) => n + f.bytes, 0))}</span>}>
      {files.length === 0
        ? <Empty><h3>No file yet</h3>Files appear when a job is merged. A finished model in another format:<Command>plat export MODEL --to spz --out FILE</Command></Empty>
        : (
          <div class="scroll"><table class="plain">
            <thead><tr><th>File</th><th class="n">Size</th><th>BLAKE3</th><th /></tr></thead>
            <tbody>
              {files.map((f) => (
                <tr key={f.path}><td><a href={`/files/${f.path.split('/').map(encodeURIComponent).join('/')}`} download>{f.name}</a></td><td class="n num">{bytes(f.bytes)}</td>
                  <td class="mono">{f.blake3 ? <span title={f.blake3}>{f.blake3.slice(0, 16)}…</span> : <span class="muted">not computed</span>}</td>
                  <td>{f.blake3 && <button type="button" class="quiet" onClick={() => void navigator.clipboard?.writeText(f.blake3!)}>Copy hash</button>}</td></tr>
              ))}
            </tbody>
          </table></div>
        )}
      {server.value?.store_url && <div class="body muted">The artefacts of all blocks are in the store: <code>{server.value.store_url}</code></div>}
    </Panel>
  );
}
