export function Events() { return <div class="empty">Events</div>; }
