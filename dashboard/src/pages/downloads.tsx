export function Downloads() { return <div class="empty">Downloads</div>; }
