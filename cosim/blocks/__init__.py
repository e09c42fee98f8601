"""Components for the master: FMUs, references and playback, and noise on connections."""
