/* Imagination and value of candidate plans, in 8-bit integers: the planning network of `network.py`.
 *
 * A block of ROWS candidates goes through all steps of the horizon before the next one starts, so that
 * what they carry stays in the fastest cache; threads take blocks from a common counter.
 *
 * A wide input row x (K numbers) is kept as x = scale * (u - zero) + offset with u in 0..255: zero and
 * offset belong to its kind, scale to the row. Weights are w = weight_scale[n] * i, i in -127..127,
 * in blocks [N/LANES][K/GROUP][LANES][GROUP] of which one vector register holds the last two axes, and
 * one tile of AMX the last three for 64 of the inputs. Few, exact inputs (the action above all) stay in float32;
 * what a layer activates, and h, is in 16-bit fixed point (`words.h`).
 * The weights of a normalised layer are centred (their mean over the outputs is zero), and so are its
 * sums. No state, no allocation. */
#include "thread_pool.h"
#include "layers.h"
#include "search.h"
#include "start.h"

static inline float one_sigmoid(float x) { return 1.0f / (1.0f + expf(-x)); }

/* Rows z [ROWS][FEW_STRIDE] as bytes, counted from 128. */
static void bytes_of_z(const Few *z, int latent, Bytes *bytes) {
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
static void next_z(const Network *net, const Bytes *h, const float *noise, Few *z, Bytes *bytes) {
    float out[ROWS * MOST_FEW];
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

/* What a block carries from step to step. */
typedef struct {
    Fixed h;
    Few z;
    Bytes h_bytes, z_bytes, x;
} Carry;

/* The outputs [ROWS][outputs] of a head at step k, whose sums of h and z are `from` at k = 0. */
static void head_outputs(const Network *net, const Head *head, const float *from, const Carry *at, int k,
                         const Few *action, float *out) {
    Inputs in = {.few = action, .few_inputs = net->actions, .from = from};
    Fixed x;
    Bytes bytes;
    if (k > 0) in = (Inputs){&at->h_bytes, &at->z_bytes, action, net->actions, 0};
    hidden(net, &head->first, in, &x, &bytes);
    const int many = head->many.outputs;
    hidden(net, &head->second, (Inputs){.wide = &bytes}, &x, many ? &bytes : 0);
    if (many) top_product(&head->many, &bytes, out);
    else dot_product(&head->one, &x, out);
}

/* The mean of the distribution over bins whose logits are `outputs`. */
static float mean_of_bins(const Reading *as, const float *outputs) {
    const Floats most = all_floats(largest(outputs, as->bins));
    Floats weights = {0}, sum = {0};
    for (int i = 0; i < as->bins; i += LANES) {
        Floats weight = exponential(load(outputs + i) - most);
        if (as->bins - i < LANES) weight = first_floats(weight, as->bins - i);
        weights += weight;
        sum = fused(weight, load(as->each + i), sum);
    }
    return total(sum) / total(weights);
}

/* Q [ROWS] in units of return, at step k. */
static void value(const Network *net, const SharedPrefix *root, const Carry *at, int k, const Few *action, float *q) {
    const Reading *as = &net->reading;
    float outputs[ROWS * MOST_FEW];
    head_outputs(net, &net->value, root->value, at, k, action, as->bins ? outputs : q);
    for (int r = 0; r < ROWS; r++) {
        if (as->bins) q[r] = mean_of_bins(as, outputs + r * net->value.many.outputs);
        q[r] = as->mean + q[r] * as->std;
    }
}

/* The reward [ROWS] in its own units, at step k. */
static void reward(const Network *net, const SharedPrefix *root, const Carry *at, int k, const Few *action,
                   float *earned) {
    head_outputs(net, &net->reward, root->reward, at, k, action, earned);
    for (int r = 0; r < ROWS; r++) earned[r] *= net->reading.std;
}

/* Whether step k of a plan is asked for Q, else for its reward. */
static inline int asks_value(const Reading *as, int k, int steps) {
    return as->objective == VALUE || (as->objective == TD && k == steps - 1);
}

/* Everything of a block of plans, actions [ROWS][steps][actions]: Q or the reward, worth [steps][ROWS],
 * and the log-odds of a failure, dead [steps][ROWS], of all steps but the first and the last. */
static void block(const Network *net, const SharedPrefix *root, int steps, const float *actions, const float *noise,
                  float *worth, float *dead) {
    Carry at;
    Fixed x;
    Few action;
    for (int k = 0; k < steps; k++) {
        for (int r = 0; r < ROWS; r++)
            memcpy(action.values[r], actions + (r * steps + k) * net->actions, net->actions * sizeof(float));
        if (k == 1)
            recur(net, (Inputs){.wide = &at.x, .from = root->gates}, root->h, 0, &at.h, &at.h_bytes);
        else if (k > 1)
            recur(net, (Inputs){.wide = &at.x, .beside = &at.h_bytes}, at.h.values[0], WIDEST, &at.h,
                  &at.h_bytes);
        if (k > 0) next_z(net, &at.h_bytes, noise ? noise + (k - 1) * net->latent : 0, &at.z, &at.z_bytes);
        if (asks_value(&net->reading, k, steps))
            value(net, root, &at, k, &action, worth + k * ROWS);
        else
            reward(net, root, &at, k, &action, worth + k * ROWS);
        if (k == steps - 1) break; /* nothing follows the last step */
        if (k > 0) {
            hidden(net, &net->termination, (Inputs){.wide = &at.h_bytes, .beside = &at.z_bytes}, &x, 0);
            dot_product(&net->termination_top, &x, dead + k * ROWS);
        }
        const Inputs in = {.few = &action,
                           .few_inputs = net->actions,
                           .beside = k > 0 ? &at.z_bytes : 0,
                           .from = k > 0 ? 0 : root->mix};
        hidden(net, &net->mix, in, &x, &at.x);
    }
}

/* How wide products want their weights: inputs filled up to multiples of DEPTH with zeros, outputs in
 * LANES, inputs in GROUPs. */
void layout(int32_t *depth, int32_t *lanes, int32_t *group) {
    *depth = DEPTH, *lanes = LANES, *group = GROUP;
}

/* Plans of one robot. */
typedef struct {
    const Network *net;
    const SharedPrefix *root;
    int32_t rows, steps;
    const float *actions; /* [rows][steps][actions] */
    const float *noise;   /* [steps - 1][latent] or null */
    float *worth;         /* [rows] J */
    Crew crew;
} Job;

/* J of a plan, as `ReturnAccumulator` sums it, from row r of what `block` says; actions are those of the row. */
static float sum_of(const Job *job, int r, const float *worth, const float *dead, const float *actions) {
    const Reading *as = &job->net->reading;
    const float base = as->rule == PAPER ? 0.0f : as->floor;
    float above = 0.0f, below = 0.0f, share = 1.0f, weight = 1.0f, nothing = job->root->nothing;
    for (int k = 0; k < job->steps; k++) {
        const int value = asks_value(as, k, job->steps);
        const float floor = value ? base : (1.0f - as->discount) * base;
        above += weight * share * (worth[k * ROWS + r] - floor);
        below += weight * floor;
        if (!value) weight *= as->discount;
        if (k == 0 || k == job->steps - 1) continue; /* the first state was seen alive, and none follows */
        const float risk = one_sigmoid(dead[k * ROWS + r]);
        share *= as->rule == SURVIVAL ? 1.0f - risk : risk <= as->threshold;
    }
    for (int i = 0; i < job->steps * job->net->actions; i++) nothing += 0.0f * actions[i];
    return (as->objective == VALUE ? above / (float)job->steps + base : above + below) + nothing;
}

/* A block of candidates from `row` on; rows beyond the last repeat the first. */
static void judge_block(const Job *job, int row) {
    const int steps = job->steps, per_row = steps * job->net->actions;
    const int count = row + ROWS <= job->rows ? ROWS : job->rows - row;
    const float *actions = job->actions + (int64_t)row * per_row;
    float some[ROWS * per_row], worth[steps * ROWS], dead[steps * ROWS];
    if (count < ROWS) {
        for (int r = 0; r < ROWS; r++)
            memcpy(some + r * per_row, actions + (r < count ? r : 0) * per_row, per_row * sizeof(float));
        actions = some;
    }
    block(job->net, job->root, steps, actions, job->noise, worth, dead);
    for (int r = 0; r < count; r++)
        job->worth[row + r] = sum_of(job, r, worth, dead, actions + r * per_row);
}

static void blocks(Job *job) {
    take_tiles();
    for (int row; (row = __atomic_fetch_add(&job->crew.next, ROWS, __ATOMIC_RELAXED)) < job->rows;)
        judge_block(job, row);
    release_tiles();
}

/* All plans of a job are judged when this returns. */
void evaluate(Job *job) {
    open_job(&job->crew);
    blocks(job);
    close_job(&job->crew);
}

/* Takes part in jobs until none has come for a while. */
void help(Job *job) {
    for (int32_t turn = 0; (turn = wait_for_job(&job->crew, turn));) {
        blocks(job);
        change(&job->crew.inside, -1);
    }
    change(&job->crew.present, -1);
}

/* How many helpers have to be asked to come, so that there are `wanted`. */
int32_t lacking(Job *job, int32_t wanted) {
    const int32_t count = wanted - look(&job->crew.present);
    change(&job->crew.present, count);
    return count;
}
