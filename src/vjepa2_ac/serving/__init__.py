"""Serve the planner over a websocket with the protocol of openpi. Only `server` and `client` use sockets."""
