/* What every model of ours is to the FMI machinery: variables by value reference, phases, what decides the future.
 *
 * config.h, printed for each model, says how large it is. Everything is static, in one translation unit (all.c), and
 * everything that changes stands in an Instance. */
#ifndef MODEL_H
#define MODEL_H

#include <math.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "config.h"
#include "floating.h"
#include "near.h"

#define TEXT_SIZE 64 /* bytes of a string, its end included */
#define GUID_SIZE 40

typedef enum { INSTANTIATED, INITIALIZATION, STEP, EVENT, CONTINUOUS, TERMINATED } Phase;
typedef enum { REAL, BOOLEAN, STRING } Kind;
typedef enum { INPUT, OUTPUT, PARAMETER } Causality;

/* A variable that has a value of its own: inputs first, then outputs, then parameters. */
typedef struct {
    const char *name, *unit;
    Kind kind;
    Causality causality;
    double start, low, high; /* of a string: its place among the texts */
} Variable;

/* Within what inputs of one quantity stay, or it is said once what happens beyond. */
typedef struct {
    const char *quantity;
    int first, count; /* among RANGE_INPUT */
    double low, high;
    const char *beyond;
} Range;

/* Commands and the times from which they hold, oldest first, in a row that grows with need. */
typedef struct {
    double *rows; /* each 1 + INPUTS numbers */
    size_t first, count, room;
} History;

typedef struct Instance Instance;
struct Instance {
    void *host; /* of the FMI layer */
    void (*log)(Instance *m, int warning, const char *message);
    int exchange; /* for model exchange */
    Phase phase;
    int computing;          /* between begin_computing and end_computing */
    FloatingMode host_mode; /* then: what the host computes with */
    double start_time, time;
    int current; /* what was set has been looked at */
    int warned;
    int is_stale; /* outputs and derivatives are older than what they depend on */
    double values[VARIABLES + 1];
    unsigned char is_set[VARIABLES + 1];
    char text[TEXTS + 1][TEXT_SIZE];
    double own[OWN + 1]; /* the model's: what decides the future beside the values */
    unsigned char awake[EFFECTS + 1];
    History history;
};

/* Printed for each model. */
static const Variable variables[VARIABLES + 1];
static const char *const texts[TEXTS + 1];

/* The model's part; each returns 0, or 1 with the reason said. */
static int initialize(Instance *m);                 /* from what was set; writes outputs */
static int advance(Instance *m, double t, double h); /* a communication step, inputs held; writes outputs */
static int refresh_outputs(Instance *m);
static void after_restore(Instance *m); /* after values and own were put back */

#define UNDEFINED 2 /* in place of 1: refused for the values of the states, which a solver chose */

/* Say something to the host; 1, so that a refusal is one line. */
static int refuse(Instance *m, const char *format, ...);
#if RANGES
static void warn(Instance *m, const char *format, ...);
#endif

#endif
