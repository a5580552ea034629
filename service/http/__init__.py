"""The server and what every request passes: connection, keys, bodies, problem documents."""
