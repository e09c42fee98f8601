"""Names of the kinds of files, for declarations and messages."""

LOG, FMU, SSP, SCENARIO = "a log", "an FMU", "an SSP", "a scenario"
MANIFEST, STUDY, MODEL, ANSWER = "a manifest", "a study", "a model file", "an answer of `cosim refine`"
FIT_STUDY = "a study of a fit"
CODE, SWEEP, RESULTS, TABLE = "a model's Python file", "a sweep", "the rows of a run", "a table of runs"
TEXT, BINARY = "a text", "a binary file"
