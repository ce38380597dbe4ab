"""What travels between processes: mail, slots, streams, and the published pose."""
