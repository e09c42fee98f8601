"""What the master steps: FMUs, references, playback; and the noise on a connection."""
