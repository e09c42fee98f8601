"""Components that the master steps: FMUs, references and playback; noise and faults of connections."""
