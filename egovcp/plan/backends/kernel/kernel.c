/* Imagination and value of candidate plans in 8-bit integers; `float_network.py` is the same in float32.
 *
 * A block of ROWS candidates goes through all steps of the horizon before the next one starts, so that
 * its state stays in the fastest cache; threads take blocks from a common counter.
 *
 * A row of a wide input x (K numbers) is stored as x = scale * (u - zero) + offset with u in 0..255: zero
 * and offset depend on the kind of input, scale on the row. Weights are w = weight_scale[n] * i, i in
 * -127..127, in blocks [N/LANES][K/GROUP][LANES][GROUP]: a vector register holds the last two axes, an AMX
 * tile the last three for 64 of the inputs. Narrow inputs (z and the action) stay in float32; activations
 * and h are in 16-bit fixed point (`fixed_point.h`). The weights of a normalised layer are centred (mean
 * zero over the outputs), and so are its sums. No global state, no allocation. */
#include "thread_pool.h"
#include "layers.h"
#include "search.h"

static inline float one_sigmoid(float x) { return 1.0f / (1.0f + expf(-x)); }

/* Rows z [ROWS][NARROW_STRIDE] as bytes with zero 128. */
static void bytes_of_z(const NarrowRows *z, int latent, Bytes *bytes) {
    for (int r = 0; r < ROWS; r++) {
        const float *x = z->values[r];
        const float scale = farthest(x, latent, 1e-6f) / 127.0f, rate = 1.0f / scale;
        for (int i = 0; i < latent; i += 2 * WORDS)
            store_bytes(bytes->values[r] + i,
                        all(128) + words_of(load(x + i) * rate, load(x + i + LANES) * rate),
                        all(128) + words_of(load(x + i + WORDS) * rate, load(x + i + WORDS + LANES) * rate));
        bytes->scale[r] = scale;
    }
}

/* z of the prior, with noise [latent] or (null) its mean; also as bytes. */
static void next_z(const Network *net, const Bytes *h, const float *noise, NarrowRows *z, Bytes *bytes) {
    float out[ROWS * MAX_NARROW];
    const int latent = net->latent;
    Fixed x;
    Bytes between;
    hidden(net, &net->prior, (Inputs){.wide = h}, &x, &between);
    top_product(&net->prior_top, &between, out);
    for (int r = 0; r < ROWS; r++) {
        const float *mean = out + r * net->prior_top.outputs;
        memcpy(z->values[r], mean, latent * sizeof(float));
        for (int i = 0; noise && i < latent; i++) {
            const float raw = mean[latent + i] + 0.54f;
            const float std = log1pf(expf(-fabsf(raw))) + (raw > 0.0f ? raw : 0.0f) + net->min_std;
            z->values[r][i] += std * noise[i];
        }
    }
    bytes_of_z(z, latent, bytes);
}

/* State of a block between steps. */
typedef struct {
    Fixed h;
    NarrowRows z;
    Bytes h_bytes, z_bytes, x;
} Carry;

/* Outputs [ROWS][outputs] of a head at step k; `from`: sums of h and z for k = 0. */
static void head_outputs(const Network *net, const Head *head, const float *from, const Carry *at, int k,
                         const NarrowRows *action, float *out) {
    Inputs in = {.narrow = action, .narrow_inputs = net->actions, .from = from};
    Fixed x;
    Bytes bytes;
    if (k > 0) in = (Inputs){&at->h_bytes, &at->z_bytes, action, net->actions, 0};
    hidden(net, &head->first, in, &x, &bytes);
    const int many = head->vector_top.outputs;
    hidden(net, &head->second, (Inputs){.wide = &bytes}, &x, many ? &bytes : 0);
    if (many) top_product(&head->vector_top, &bytes, out);
    else dot_product(&head->scalar_top, &x, out);
}

/* The mean of the distribution over bins whose logits are `outputs`. */
static float mean_of_bins(const Readout *as, const float *outputs) {
    const Floats most = all_floats(largest(outputs, as->bins));
    Floats weights = {0}, sum = {0};
    for (int i = 0; i < as->bins; i += LANES) {
        Floats weight = exponential(load(outputs + i) - most);
        if (as->bins - i < LANES) weight = first_floats(weight, as->bins - i);
        weights += weight;
        sum = fused(weight, load(as->bin_values + i), sum);
    }
    return total(sum) / total(weights);
}

/* Q [ROWS] in units of return, at step k. */
static void value(const Network *net, const SharedPrefix *prefix, const Carry *at, int k,
                  const NarrowRows *action, float *q) {
    const Readout *as = &net->readout;
    float outputs[ROWS * MAX_NARROW];
    head_outputs(net, &net->value, prefix->value, at, k, action, as->bins ? outputs : q);
    for (int r = 0; r < ROWS; r++) {
        if (as->bins) q[r] = mean_of_bins(as, outputs + r * net->value.vector_top.outputs);
        q[r] = as->mean + q[r] * as->std;
    }
}

/* The reward [ROWS] in its own units, at step k. */
static void reward(const Network *net, const SharedPrefix *prefix, const Carry *at, int k,
                   const NarrowRows *action, float *rewards) {
    head_outputs(net, &net->reward, prefix->reward, at, k, action, rewards);
    for (int r = 0; r < ROWS; r++) rewards[r] *= net->readout.std;
}

/* Whether step k of a plan contributes Q, rather than its reward. */
static inline int needs_value(const Readout *as, int k, int steps) {
    return as->objective == VALUE || (as->objective == TD && k == steps - 1);
}

/* Evaluates a block of plans, actions [ROWS][steps][actions]: Q or reward, values [steps][ROWS], and the
 * log-odds of termination, logits [steps][ROWS], of all steps but the first and the last. */
static void block(const Network *net, const SharedPrefix *prefix, int steps, const float *actions,
                  const float *noise, float *values, float *logits) {
    Carry at;
    Fixed x;
    NarrowRows action;
    for (int k = 0; k < steps; k++) {
        for (int r = 0; r < ROWS; r++)
            memcpy(action.values[r], actions + (r * steps + k) * net->actions, net->actions * sizeof(float));
        if (k == 1)
            recur(net, (Inputs){.wide = &at.x, .from = prefix->gates}, prefix->h, 0, &at.h, &at.h_bytes);
        else if (k > 1)
            recur(net, (Inputs){.wide = &at.x, .second = &at.h_bytes}, at.h.values[0], MAX_WIDE, &at.h,
                  &at.h_bytes);
        if (k > 0) next_z(net, &at.h_bytes, noise ? noise + (k - 1) * net->latent : 0, &at.z, &at.z_bytes);
        if (needs_value(&net->readout, k, steps))
            value(net, prefix, &at, k, &action, values + k * ROWS);
        else
            reward(net, prefix, &at, k, &action, values + k * ROWS);
        if (k == steps - 1) break;
        if (k > 0) {
            hidden(net, &net->termination, (Inputs){.wide = &at.h_bytes, .second = &at.z_bytes}, &x, 0);
            dot_product(&net->termination_top, &x, logits + k * ROWS);
        }
        const Inputs in = {.narrow = &action,
                           .narrow_inputs = net->actions,
                           .second = k > 0 ? &at.z_bytes : 0,
                           .from = k > 0 ? 0 : prefix->mix};
        hidden(net, &net->mix, in, &x, &at.x);
    }
}

/* Memory layout of the weights of wide products: inputs padded to multiples of DEPTH with zeros, outputs
 * in LANES, inputs in GROUPs. */
void weight_layout(int32_t *depth, int32_t *lanes, int32_t *group) {
    *depth = DEPTH, *lanes = LANES, *group = GROUP;
}

/* Plans of one robot. */
typedef struct {
    const Network *net;
    const SharedPrefix *prefix;
    int32_t plans, steps;
    const float *actions; /* [plans][steps][actions] */
    const float *noise;   /* [steps - 1][latent] or null */
    float *values;        /* [plans] V */
    ThreadPool pool;
} Job;

/* V of a plan, as in `ReturnAccumulator`, from row r of the results of `block` and the row's actions. */
static float plan_value(const Job *job, int r, const float *values, const float *logits,
                    const float *actions) {
    const Readout *as = &job->net->readout;
    const float base = as->rule == PAPER ? 0.0f : as->floor;
    float above = 0.0f, below = 0.0f, survival = 1.0f, weight = 1.0f;
    float nan_or_zero = job->prefix->nan_or_zero;
    for (int k = 0; k < job->steps; k++) {
        const int value = needs_value(as, k, job->steps);
        const float floor = value ? base : (1.0f - as->discount) * base;
        above += weight * survival * (values[k * ROWS + r] - floor);
        below += weight * floor;
        if (!value) weight *= as->discount;
        if (k == 0 || k == job->steps - 1) continue; /* first state observed, last without effect */
        const float risk = one_sigmoid(logits[k * ROWS + r]);
        survival *= as->rule == SURVIVAL ? 1.0f - risk : risk <= as->threshold;
    }
    for (int i = 0; i < job->steps * job->net->actions; i++) nan_or_zero += 0.0f * actions[i];
    return (as->objective == VALUE ? above / (float)job->steps + base : above + below) + nan_or_zero;
}

/* Evaluates a block of candidates from `row` on; rows beyond the last repeat the first. */
static void evaluate_block(const Job *job, int row) {
    const int steps = job->steps, per_row = steps * job->net->actions;
    const int count = row + ROWS <= job->plans ? ROWS : job->plans - row;
    const float *actions = job->actions + (int64_t)row * per_row;
    float padded[ROWS * per_row], values[steps * ROWS], logits[steps * ROWS];
    if (count < ROWS) {
        for (int r = 0; r < ROWS; r++)
            memcpy(padded + r * per_row, actions + (r < count ? r : 0) * per_row, per_row * sizeof(float));
        actions = padded;
    }
    block(job->net, job->prefix, steps, actions, job->noise, values, logits);
    for (int r = 0; r < count; r++)
        job->values[row + r] = plan_value(job, r, values, logits, actions + r * per_row);
}

static void evaluate_blocks(Job *job) {
    take_tiles();
    for (int row; (row = __atomic_fetch_add(&job->pool.next, ROWS, __ATOMIC_RELAXED)) < job->plans;)
        evaluate_block(job, row);
    release_tiles();
}

/* Evaluates all plans of a job. */
void evaluate(Job *job) {
    open_job(&job->pool);
    evaluate_blocks(job);
    close_job(&job->pool);
}

/* Body of a worker: takes part in jobs until none starts for TIMEOUT_NS. */
void work(Job *job) {
    for (int32_t turn = 0; (turn = wait_for_job(&job->pool, turn));) {
        evaluate_blocks(job);
        add_atomic(&job->pool.active, -1);
    }
    add_atomic(&job->pool.workers, -1);
}

/* Number of workers to start, so that there are `wanted`. */
int32_t missing_workers(Job *job, int32_t wanted) {
    const int32_t count = wanted - load_atomic(&job->pool.workers);
    add_atomic(&job->pool.workers, count);
    return count;
}
