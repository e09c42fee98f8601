"""Systems with known answers: a formula, a sentence of a standard, or an independent integrator at 1e-12."""
