"""REST and WebSocket: routers that translate requests and answers, and decide nothing."""
