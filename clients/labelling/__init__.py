"""The data loop: roll a model out over HTTP, keep the scenes it could do better on, a teacher says why."""
