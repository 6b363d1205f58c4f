export function Cluster() { return <div class="empty">Cluster</div>; }
