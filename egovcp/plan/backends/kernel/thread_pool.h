/* Threads that share the blocks of a job. Workers spin between the jobs of a search: to wake a sleeping
 * thread takes longer than to sample the candidates of an iteration. */
#pragma once
#include <sched.h>
#include <stdint.h>
#include <time.h>

enum { TIMEOUT_NS = 1000000, SPINS = 32 };

typedef struct {
    int32_t next;    /* next row of the job */
    int32_t turn;    /* odd while there is a job */
    int32_t active;  /* workers that may be reading the job */
    int32_t workers; /* workers that run, or are being started */
} ThreadPool;

static inline void pause_cpu(void) {
#if defined(__x86_64__)
    __builtin_ia32_pause();
#endif
}

static inline int64_t clock_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

static inline int32_t load_atomic(const int32_t *x) { return __atomic_load_n(x, __ATOMIC_SEQ_CST); }

static inline void add_atomic(int32_t *x, int32_t by) { __atomic_fetch_add(x, by, __ATOMIC_SEQ_CST); }

/* A worker waits for a job other than the one of turn `seen`; returns its turn, or 0 after TIMEOUT_NS. With a
 * job, the worker is counted as active. */
static int32_t wait_for_job(ThreadPool *pool, int32_t seen) {
    const int64_t until = clock_ns() + TIMEOUT_NS;
    for (;;) {
        for (int i = 0; i < SPINS; i++, pause_cpu()) {
            const int32_t turn = load_atomic(&pool->turn);
            if (!(turn & 1) || turn == seen) continue;
            add_atomic(&pool->active, 1);
            if (load_atomic(&pool->turn) == turn) return turn;
            add_atomic(&pool->active, -1); /* it has ended */
        }
        if (clock_ns() > until) return 0;
        sched_yield(); /* yield the core to other threads */
    }
}

static void open_job(ThreadPool *pool) {
    __atomic_store_n(&pool->next, 0, __ATOMIC_RELAXED);
    add_atomic(&pool->turn, 1);
}

/* After this returns, no worker reads the job. */
static void close_job(ThreadPool *pool) {
    add_atomic(&pool->turn, 1);
    while (load_atomic(&pool->active)) {
        for (int i = 0; i < SPINS && load_atomic(&pool->active); i++) pause_cpu();
        sched_yield(); /* a worker may need this core */
    }
}
