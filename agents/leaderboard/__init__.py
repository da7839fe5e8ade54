"""The leaderboard: the protocol, its file and its tables."""
