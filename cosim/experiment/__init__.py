"""Design of experiments that separate rival hypotheses within limits of signals."""
