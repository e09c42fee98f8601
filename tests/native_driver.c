/* A host of a few lines, linked with the sources of a native FMU: two instances at once, every way, every refusal. It rounds
 * towards zero, and looks after each call, and in its logger, whether it still does and computes with subnormal numbers. */
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "config.h"
#include "fmi2Functions.h"

#if defined(__x86_64__)
#include <xmmintrin.h>
#define HOST_MODE (0x1f80u | _MM_ROUND_TOWARD_ZERO) /* every exception masked, none raised */
static void set_mode(void) { _mm_setcsr(HOST_MODE); }
static int is_changed(void) { return (_mm_getcsr() & ~_MM_EXCEPT_MASK) != HOST_MODE; }
#else
static void set_mode(void) { }
static int is_changed(void) { return 0; }
#endif

static int said;

static void logger(fmi2ComponentEnvironment e, fmi2String name, fmi2Status status, fmi2String category, fmi2String message, ...)
{
    (void)e, (void)name, (void)status, (void)category;
    va_list arguments;
    char text[4096];
    va_start(arguments, message);
    vsnprintf(text, sizeof text, message, arguments);
    va_end(arguments);
    said++;
    if (is_changed()) { printf("the logger has another floating-point mode: %s\n", text); exit(1); }
}

static const fmi2CallbackFunctions CALLBACKS = {logger, calloc, free, NULL, NULL};

#define CHECK(call, wanted) \
    do { \
        fmi2Status got = (call); \
        if (is_changed()) { printf("line %d: %s leaves another floating-point mode\n", __LINE__, #call); exit(1); } \
        if (got != (wanted)) { printf("line %d: %s is %d\n", __LINE__, #call, (int)got); exit(1); } \
    } while (0)

static fmi2Component begun(fmi2Type type, int argc, char **argv)
{
    fmi2Component c = fmi2Instantiate("one", type, MODEL_GUID, NULL, &CALLBACKS, fmi2False, fmi2True);
    if (c == NULL) exit(2);
    CHECK(fmi2SetupExperiment(c, fmi2False, 0.0, 0.0, fmi2False, 0.0), fmi2OK);
    CHECK(fmi2EnterInitializationMode(c), fmi2OK);
    for (int k = 1; k + 1 < argc; k += 2) {
        fmi2ValueReference vr = (fmi2ValueReference)atoi(argv[k]);
        fmi2Real value = atof(argv[k + 1]);
        CHECK(fmi2SetReal(c, &vr, 1, &value), fmi2OK);
    }
    CHECK(fmi2ExitInitializationMode(c), fmi2OK);
    return c;
}

static void steps(fmi2Component c, int from, int to, double step)
{
    for (int k = from; k < to; k++) {
        for (fmi2ValueReference vr = 0; vr < INPUTS; vr++) {
            fmi2Real u = 0.0, value;
            CHECK(fmi2GetReal(c, &vr, 1, &u), fmi2OK);
            value = u + (k % 3 ? 0.01 : -0.02);
            CHECK(fmi2SetReal(c, &vr, 1, &value), fmi2OK);
        }
        CHECK(fmi2DoStep(c, k * step, step, fmi2True), fmi2OK);
    }
}

int main(int argc, char **argv)
{
    const double step = atof(argv[1]);
    set_mode();
    argc--, argv++;
    if (fmi2Instantiate("one", fmi2CoSimulation, "{other}", NULL, &CALLBACKS, fmi2False, fmi2False) != NULL) return 3;
    fmi2Component a = begun(fmi2CoSimulation, argc, argv), b = begun(fmi2CoSimulation, argc, argv);
    steps(a, 0, 200, step);
    fmi2FMUstate state = NULL, copy = NULL;
    size_t size;
    CHECK(fmi2GetFMUstate(a, &state), fmi2OK);
    CHECK(fmi2SerializedFMUstateSize(a, state, &size), fmi2OK);
    char *bytes = malloc(size);
    CHECK(fmi2SerializeFMUstate(a, state, bytes, size), fmi2OK);
    steps(a, 200, 300, step);
    CHECK(fmi2DeSerializeFMUstate(b, bytes, size, &copy), fmi2OK);
    CHECK(fmi2SetFMUstate(b, copy), fmi2OK);
    steps(b, 200, 300, step);
    for (fmi2ValueReference vr = INPUTS; vr < INPUTS + OUTPUTS; vr++) {
        fmi2Real x, y;
        CHECK(fmi2GetReal(a, &vr, 1, &x), fmi2OK);
        CHECK(fmi2GetReal(b, &vr, 1, &y), fmi2OK);
        if (memcmp(&x, &y, sizeof x) != 0) return 4;
    }
    CHECK(fmi2FreeFMUstate(b, &copy), fmi2OK);
    /* what is refused is said, and hurts nothing */
    bytes[0] ^= 1;
    CHECK(fmi2DeSerializeFMUstate(b, bytes, size, &copy), fmi2OK);
    CHECK(fmi2SetFMUstate(b, copy), fmi2Error);
    free(copy);
    CHECK(fmi2DeSerializeFMUstate(b, bytes, 7, &copy), fmi2OK);
    CHECK(fmi2SetFMUstate(b, copy), fmi2Error);
    CHECK(fmi2FreeFMUstate(b, &copy), fmi2OK);
    CHECK(fmi2FreeFMUstate(a, &state), fmi2OK);
    const fmi2ValueReference unknown[] = {1000000, INPUTS};
    fmi2Real value = 1.0, nothing = 0.0;
    CHECK(fmi2GetReal(a, unknown, 1, &value), fmi2Error);
    CHECK(fmi2SetReal(a, unknown + 1, 1, &value), fmi2Error);
    nothing /= nothing;
    CHECK(fmi2SetReal(a, (fmi2ValueReference[]){0}, 1, &nothing), fmi2Error);
    CHECK(fmi2DoStep(a, 0.0, -1.0, fmi2True), fmi2Error);
    CHECK(fmi2DoStep(a, 0.0, 1e9, fmi2True), fmi2Error); /* said while it computes */
    CHECK(fmi2Reset(a), fmi2OK);
    CHECK(fmi2DoStep(a, 0.0, step, fmi2True), fmi2Error);
    fmi2FreeInstance(a);
    fmi2FreeInstance(b);
    free(bytes);
#if EXCHANGE
    fmi2Component c = begun(fmi2ModelExchange, argc, argv);
    double x[STATES + 1], dx[STATES + 1], z[KINKS + 1];
    fmi2EventInfo info;
    fmi2Boolean event, end;
    for (int k = 0; k < 200; k++) {
        CHECK(fmi2NewDiscreteStates(c, &info), fmi2OK);
        CHECK(fmi2EnterContinuousTimeMode(c), fmi2OK);
        CHECK(fmi2GetContinuousStates(c, x, STATES), fmi2OK);
        CHECK(fmi2GetDerivatives(c, dx, STATES), fmi2OK);
        CHECK(fmi2GetEventIndicators(c, z, KINKS), fmi2OK);
        for (int i = 0; i < STATES; i++) x[i] += 0.001 * dx[i];
        CHECK(fmi2SetTime(c, (k + 1) * 0.001), fmi2OK);
        CHECK(fmi2SetContinuousStates(c, x, STATES), fmi2OK);
        CHECK(fmi2CompletedIntegratorStep(c, fmi2True, &event, &end), fmi2OK);
        CHECK(fmi2EnterEventMode(c), fmi2OK);
        fmi2ValueReference vr = 0;
        fmi2Real u = 0.001 * k;
        if (INPUTS > 0) CHECK(fmi2SetReal(c, &vr, 1, &u), fmi2OK);
        const fmi2ValueReference of = VARIABLES + STATES, by = VARIABLES;
        fmi2Real one = 1.0, slope;
        if (STATES > 0) CHECK(fmi2GetDirectionalDerivative(c, &of, 1, &by, 1, &one, &slope), fmi2OK);
    }
    CHECK(fmi2Terminate(c), fmi2OK);
    fmi2FreeInstance(c);
#endif
    printf("%d said\n", said);
    return 0;
}
