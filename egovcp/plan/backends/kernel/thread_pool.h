/* Threads that share the blocks of a job. Helpers wait for the next job of a search where they are: to
 * wake a thread that sleeps takes longer than to draw a round's candidates. */
#pragma once
#include <sched.h>
#include <stdint.h>
#include <time.h>

enum { PATIENCE_NS = 1000000, LOOKS = 32 };

typedef struct {
    int32_t next;    /* row of the job that is given out next */
    int32_t turn;    /* odd while there is a job */
    int32_t inside;  /* helpers that may be reading the job */
    int32_t present; /* helpers that have come, or been asked to */
} Crew;

static inline void rest(void) {
#if defined(__x86_64__)
    __builtin_ia32_pause();
#endif
}

static inline int64_t clock_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

static inline int32_t look(const int32_t *x) { return __atomic_load_n(x, __ATOMIC_SEQ_CST); }

static inline void change(int32_t *x, int32_t by) { __atomic_fetch_add(x, by, __ATOMIC_SEQ_CST); }

/* A helper's wait for a job other than the one of turn `seen`: its turn, or 0 if none came in time. Who
 * gets one is inside. */
static int32_t wait_for_job(Crew *crew, int32_t seen) {
    const int64_t until = clock_ns() + PATIENCE_NS;
    for (;;) {
        for (int i = 0; i < LOOKS; i++, rest()) {
            const int32_t turn = look(&crew->turn);
            if (!(turn & 1) || turn == seen) continue;
            change(&crew->inside, 1);
            if (look(&crew->turn) == turn) return turn;
            change(&crew->inside, -1); /* it has ended */
        }
        if (clock_ns() > until) return 0;
        sched_yield(); /* whoever else wants this core is to have it */
    }
}

static void open_job(Crew *crew) {
    __atomic_store_n(&crew->next, 0, __ATOMIC_RELAXED);
    change(&crew->turn, 1);
}

/* No helper reads the job any more once this returns. */
static void close_job(Crew *crew) {
    change(&crew->turn, 1);
    while (look(&crew->inside)) {
        for (int i = 0; i < LOOKS && look(&crew->inside); i++) rest();
        sched_yield(); /* a helper may be waiting for this very core */
    }
}
