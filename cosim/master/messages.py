"""Messages of stepping: initialization, events and clocks, early ends, observers, disk space."""

from cosim.base.messages import Template

NOT_SETTLED = Template(
    "E-MAS-001",
    "it still changes after {count} exchanges of initialization: an algebraic loop that exchanging values does not "
    "settle; an FMU without direct feedthrough in the loop breaks it",
)
OPEN_LOOP = Template(
    "N-MAS-066",
    "{error}. {left_open}",
)
STATE_NOT_RESTORED = Template(
    "E-MAS-002",
    "its outputs differ after a saved state is restored; use an FMU that restores its state, or one that does not "
    "declare that it can",
)
OBSERVER_FAILED = Template("E-MAS-003", "{error}: {reason}")
UNEXPECTED_ERROR = Template("E-MAS-004", "{call}: {error}: {reason} (--in-process shows where)")
END_REQUESTED = Template("N-MAS-006", "it asked for the end")
UNUSABLE_STATE = Template(
    "E-MAS-062", "the checkpoint has no state of these components ({reason}); run the scenario again from its start"
)
NOT_REPEATED = Template(
    "E-MAS-060",
    "its outputs differ from the recorded ones when its recorded inputs are replayed, so the run cannot go on; run the "
    "scenario again from its start",
)
OTHER_BEGINNING = Template(
    "E-MAS-061",
    "the components begin with other values than in the run that was to go on; run the scenario again from its start",
)
STOPPED_AFTER_CHECKPOINT = Template("N-MAS-062", "stopped after a checkpoint")
ENDED_EARLY = Template("N-MAS-007", "{component} ended the simulation at t = {time:.6g} s: {reason}")
LOOP_NOT_SOLVED = Template(
    "E-MAS-008",
    "{loop} does not converge: after {count} iterations {signal} is {value:.6g}, and the loop returns {residual:+.3g} "
    "more (relative tolerance {tolerance:g}). Signals of the loop: {signals}. If it has a solution, start values near "
    "it help{more}; order: [...] or algorithm: jacobi do not solve it",
)
LARGER_TOLERANCE = Template(
    "N-MAS-064", ", or a larger tolerance: this residual is rounding (loops: {{tolerance: {tolerance:g}}})"
)
ROUGH_SOLUTION = Template(
    "W-MAS-067",
    "the algebraic loop {loop} is solved less exactly than to {tolerance:g} of its signals at {count} points: first at "
    "t = {time:.6g} s, where {signal} is {value:.3g} and the loop returns {residual:.2g} more or less, which no "
    "iteration makes smaller. A nominal value of this input in its FMU states the size that counts",
)
MORE_ITERATIONS = Template("N-MAS-063", ", or more iterations (loops: {{iterations: {count}}})")
TOLERANCE_NOT_MET = Template(
    "W-MAS-011",
    "the error of {count} steps is above the tolerance {tolerance:g} although min allows no shorter ones, {step:g} s: "
    "first at t = {time:.6g} s, {error:.2g} of {signal}; the largest is {worst:.2g}. Give a shorter min or a larger "
    "tolerance",
)
TOLERANCE_EXCEEDED = Template(
    "W-MAS-065",
    "the error of {count} steps turned out above the tolerance {tolerance:g}; estimator: {estimator} does not repeat "
    "steps: first at t = {time:.6g} s, {error:.2g} of {signal}; the largest is {worst:.2g}. Give a max below {step:g} "
    "s or a larger tolerance",
)
SMALL_SIGNALS = Template(
    "W-MAS-072",
    "{count} signals stay so far below their nominal value, 1 if the FMU states none, that a step within the tolerance "
    "{tolerance:g} may err by up to {share:.2g} times the signal: {names}. State their nominal values in the FMUs, or "
    "give a smaller tolerance",
)
NOTHING_JUDGED = Template(
    "W-MAS-012",
    "no input is extrapolated, so that estimator: residual judges nothing and steps grow to {step:g} s whatever their "
    "error; give one step: of that length, or FMUs that save and restore their state (estimator: halving)",
)
NO_WAY_BACK = Template(
    "E-MAS-009",
    "{output} follows {input} only after a step, which cannot be repeated, because the FMU saves no state; so the "
    "algebraic loop {loop} cannot be solved. {cure}",
)
OPEN_SETTLES = Template(
    "N-MAS-068",
    "order: [...] or algorithm: jacobi leaves it open, with values of the step before, which settle (the loop gain is "
    "{gain:.3g})",
)
OPEN_GROWS = Template(
    "N-MAS-069",
    "order: [...] or algorithm: jacobi is no cure: with values of the step before, they grow (the loop gain is "
    "{gain:.3g}). The loop needs an FMU that saves and restores its state, or one without direct feedthrough",
)
NO_UNIQUE_SOLUTION = Template(
    "E-MAS-070",
    "{loop} has no solution, or no unique one: its gain is 1, so that the loop returns {residual:+.3g} more than "
    "{signal}, whatever its value. Signals of the loop: {signals}. No start value, tolerance, order or algorithm is a "
    "cure; change its equations (a parameter of an FMU), or put an FMU without direct feedthrough into it",
)
LATE_WITHOUT_STATE = Template("N-MAS-073", "{component} answers only after a step and cannot save its state")
LATE_UNDECLARED = Template("N-MAS-074", "{component} answers no input without a step, and none is declared to act")
LOOP_DELAYED = Template(
    "W-MAS-075",
    "the algebraic loop {loop} is not solved: {reason}. Each step has the inputs of its start; at its end the loop "
    "returns others, by {median:.2g} of the signal at half of the points and {last:.2g} at the last; the largest "
    "residual is {residual:+.3g} of {signal} at t = {time:.6g} s. A shorter step makes a residual of motion smaller",
)
LOOP_GROWS = Template(
    "E-MAS-076",
    "{loop} is not solved ({reason}) and grows without bound: {signal} is {value:.3g} in the last step, and the loop "
    "returns {residual:+.3g} more, a residual that doubles in equal times. It needs an FMU that saves and restores its "
    "state, or one without direct feedthrough; a shorter step if the growth is of motion; order: [...] runs it without "
    "this judgement",
)
LAST_RESIDUAL = Template(
    "N-MAS-077",
    "{loop} is an algebraic loop that is not solved: {reason}; at t = {time:.6g} s {signal} was {value:.3g} and the "
    "loop returned {residual:+.3g} more",
)
UNDECLARED_AND_SILENT = Template(
    "W-MAS-071",
    "{component}: no output in the algebraic loop {loop} follows an input without a step, and none is declared to; its "
    "outputs are those after a step with the inputs of the step's start. If a step shows feedthrough, state it "
    "(components.{component}.feedthrough: [{inputs}])",
)

# Events and clocks
EVENT_NOT_SETTLED = Template(
    "E-MAS-031",
    "it still changes after {count} exchanges of values at one event: an algebraic loop between FMUs in event mode "
    "that exchanging values does not settle",
)
EVENTS_WITHOUT_END = Template(
    "E-MAS-032",
    "it still changes after {count} updates of discrete states at one time; these FMUs ask for another one: {names}",
)
EVENTS_CROWD = Template("E-MAS-033", "{count} events within {span:.2g} s, so that time stands still")
CLOCK_TOO_FAST = Template(
    "E-MAS-034",
    "the clock ticks every {interval:g} s, but its FMU takes only steps of {step:g} s; shorten the step of the "
    "scenario",
)
AHEAD_OF_EVENT = Template(
    "W-MAS-035",
    "{component} was up to {lead:.3g} s ahead of an event of another FMU, because both may return early from a step "
    "and it cannot go back: it got {count} such events that much later. A shorter step of the scenario shortens this",
)

# Real time
PACE_LOST = Template(
    "W-MAS-051",
    "{count} of {points} communication points came more than a step behind the pace {pace:g}, at worst {worst:.3g} ms "
    "at t = {at:.6g} s; the run caught up",
)
PACE_NOT_KEPT = Template(
    "W-MAS-052",
    "the pace {pace:g} is not kept: {count} of {points} communication points came more than a step late, at worst "
    "{worst:.3g} ms at t = {at:.6g} s, and the last {end:.3g} ms; the run went on as fast as it could",
)
NO_FUNCTION = Template("E-MAS-058", "{name} is of type {value}; give a function of time and signals")
