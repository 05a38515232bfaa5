"""Serving: the planner behind a websocket, in the protocol of openpi. Wire format and session know no sockets."""
