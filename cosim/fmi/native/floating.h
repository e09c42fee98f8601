/* Subnormal numbers, those below 2.2e-308, are zero while a model computes. A state that decays ends among them, and most
 * processors take a hundred cycles and more for one operation on such a number.
 *
 * The mode belongs to the thread: what the host had is put back before it goes on, also for its logger. A compiler moves no
 * load and no store across a change of mode. On a processor or a compiler that is not listed nothing is changed. */
#ifndef FLOATING_H
#define FLOATING_H

#if defined(__GNUC__) && defined(__x86_64__)
typedef unsigned int FloatingMode;
#define SUBNORMALS_ARE_ZERO 0x8040u /* MXCSR: of results (FTZ) and of operands (DAZ) */
#define READ_MODE(mode) __asm__ volatile("stmxcsr %0" : "=m"(mode) : : "memory")
#define WRITE_MODE(mode) __asm__ volatile("ldmxcsr %0" : : "m"(mode) : "memory")
#elif defined(__GNUC__) && defined(__aarch64__)
typedef unsigned long long FloatingMode;
#define SUBNORMALS_ARE_ZERO (1ull << 24) /* FPCR: FZ, of results and operands */
#define READ_MODE(mode) __asm__ volatile("mrs %0, fpcr" : "=r"(mode) : : "memory")
#define WRITE_MODE(mode) __asm__ volatile("msr fpcr, %0" : : "r"(mode) : "memory")
#else
typedef unsigned int FloatingMode;
#define SUBNORMALS_ARE_ZERO 0u
#define READ_MODE(mode) ((mode) = 0u)
#define WRITE_MODE(mode) ((void)(mode))
#endif

/* Take subnormal numbers for zero; return the mode of before. */
static inline FloatingMode flush_subnormals(void)
{
    FloatingMode before, flushing;
    READ_MODE(before);
    flushing = before | SUBNORMALS_ARE_ZERO;
    WRITE_MODE(flushing);
    return before;
}

static inline void restore_mode(FloatingMode mode)
{
    WRITE_MODE(mode);
}

#endif
