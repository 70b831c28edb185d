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
#include "crew.h"
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
    const int latent = net->latent, outputs = net->prior_outputs;
    Fixed x;
    Bytes between;
    hidden(net, &net->prior, (Inputs){.wide = h}, &x, &between);
    wide_product(&net->prior_top, outputs, &between, net->prior_bias, 0, out);
    for (int r = 0; r < ROWS; r++) {
        const float *mean = out + r * outputs;
        memcpy(z->values[r], mean, latent * sizeof(float));
        for (int i = 0; noise && i < latent; i++) {
            const float raw = mean[latent + i] + 0.54f;
            const float std = log1pf(expf(-fabsf(raw))) + (raw > 0.0f ? raw : 0.0f) + net->min_std;
            z->values[r][i] += std * noise[i];
        }
    }
    bytes_of_z(z, latent, bytes);
}

/* What is on its way, to `told` of each row: its probability, and that times where and when. */
static void tell(const Network *net, const Bytes *h, const Bytes *z, float *told, int stride) {
    Fixed x;
    Few out = {{{0}}};
    hidden(net, &net->told, (Inputs){.wide = h, .beside = z}, &x, 0);
    linear(&net->told_top, &x, out.values[0], FEW_STRIDE);
    for (int r = 0; r < ROWS; r++) {
        const float coming = one_sigmoid(out.values[r][3]);
        told[r * stride] = coming;
        for (int i = 0; i < 3; i++) told[r * stride + 1 + i] = coming * out.values[r][i];
    }
}

/* q [ROWS][stride] += the outputs of a network of two hidden layers. */
static void mlp(const Network *net, const Mlp *m, Inputs in, float *q, int stride) {
    Fixed x;
    Bytes bytes;
    hidden(net, &m->first, in, &x, &bytes);
    hidden(net, &m->second, (Inputs){.wide = &bytes}, &x, 0);
    linear(&m->top, &x, q, stride);
}

/* What a block carries from step to step. */
typedef struct {
    Fixed h;
    Few z;
    Bytes h_bytes, z_bytes, x;
} Carry;

/* both [ROWS][width] += what the heads share, at step k; `few` has the action. */
static void shared_part(const Network *net, const Root *root, const Carry *at, int k, Few *few, float *both,
                        int width) {
    const int actions = net->actions;
    Inputs in = {.few = few, .few_inputs = actions, .from = root->passing};
    if (k > 0) {
        in = (Inputs){.few = few, .few_inputs = actions + TOLD};
        for (int r = 0; root->told && r < ROWS; r++)
            memcpy(few->values[r] + actions, root->told + k * TOLD, TOLD * sizeof(float));
        if (!root->told) tell(net, &at->h_bytes, &at->z_bytes, few->values[0] + actions, FEW_STRIDE);
    }
    mlp(net, &net->passing, in, both, width);
}

/* q [ROWS][stride] += a head's own part, at step k; `few` has the action. */
static void own_part(const Network *net, const Head *head, const float *from, const Carry *at, int k,
                     Few *few, float *q, int stride) {
    Inputs in = {.few = few, .few_inputs = net->actions, .from = k > 0 ? 0 : from};
    const int reduced = head->reduce_h.outputs;
    if (k > 0 && reduced) {
        float *to = few->values[0] + net->actions;
        for (int r = 0; r < ROWS; r++) memset(to + r * FEW_STRIDE, 0, reduced * sizeof(float));
        linear(&head->reduce_h, &at->h, to, FEW_STRIDE);
        add_narrow(&head->reduce_z, reduced, &at->z, to);
        in.few_inputs = head->state.first.few.inputs;
    } else if (k > 0) {
        in.wide = &at->h_bytes, in.beside = &at->z_bytes;
    }
    mlp(net, &head->state, in, q, stride);
}

/* Whether step k of a plan is asked for Q, else for its reward. */
static inline int asks_value(const Reading *as, int k, int steps) {
    return as->objective == VALUE || (as->objective == TD && k == steps - 1);
}

/* q [ROWS][stride], of which a row has the outputs [heads][width], += Q's heads at step k. */
static void judged(const Network *net, const Root *root, const Carry *at, int k, Few *few, float *q, int width,
                   int stride) {
    const int shared = net->passing.top.outputs;
    float both[ROWS * MOST_FEW] = {0}; /* [ROWS][width] */
    if (shared) shared_part(net, root, at, k, few, both, width);
    for (int i = 0; i < net->heads; i++, q += width) {
        own_part(net, net->head + i, root->values[i], at, k, few, q, stride);
        for (int r = 0; shared && r < ROWS; r++)
            for (int j = 0; j < width; j++) q[r * stride + j] += both[r * width + j];
    }
}

/* What heads say of a block, zero before: where Q is asked its outputs q [ROWS][steps][heads][width],
 * elsewhere rewards earned [ROWS][steps]; and the log-odds of a failure, dead [ROWS][steps]. */
typedef struct {
    float *q, *earned, *dead;
} Answers;

/* Everything of a block of plans, actions [ROWS][steps][actions]. */
static void block(const Network *net, const Root *root, int steps, const float *actions, const float *noise,
                  int width, Answers to) {
    Carry at;
    Fixed x;
    Few few;
    const int q_step = net->heads * width;
    for (int k = 0; k < steps; k++) {
        for (int r = 0; r < ROWS; r++)
            memcpy(few.values[r], actions + (r * steps + k) * net->actions, net->actions * sizeof(float));
        if (k == 1)
            recur(net, (Inputs){.wide = &at.x, .from = root->gates}, root->h, 0, &at.h, &at.h_bytes);
        else if (k > 1)
            recur(net, (Inputs){.wide = &at.x, .beside = &at.h_bytes}, at.h.values[0], WIDEST, &at.h,
                  &at.h_bytes);
        if (k > 0) next_z(net, &at.h_bytes, noise ? noise + (k - 1) * net->latent : 0, &at.z, &at.z_bytes);
        if (asks_value(&net->reading, k, steps))
            judged(net, root, &at, k, &few, to.q + k * q_step, width, steps * q_step);
        else
            own_part(net, &net->reward, root->values[net->heads], &at, k, &few, to.earned + k, steps);
        if (k == steps - 1) break; /* nothing follows the last step */
        if (k > 0) {
            hidden(net, &net->termination, (Inputs){.wide = &at.h_bytes, .beside = &at.z_bytes}, &x, 0);
            linear(&net->termination_top, &x, to.dead + k, steps);
        }
        const Inputs in = {.few = &few,
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
    const Root *root;
    int32_t rows, steps, width; /* width: of a head's outputs, filled up to 16 if there are several */
    const float *actions; /* [rows][steps][actions] */
    const float *noise;   /* [steps - 1][latent] or null */
    float *worth;         /* [rows] J */
    Crew crew;
} Job;

/* What a head says: its output, or the mean of the distribution whose log-odds its outputs are. */
static float said(const Reading *as, const float *outputs) {
    if (!as->bins) return outputs[0];
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

/* Q in units of return, from the outputs of the heads [heads][width]. */
static float value_of(const Network *net, const float *q, int width) {
    const Reading *as = &net->reading;
    float value = said(as, q);
    for (int i = 1; i < net->heads; i++) {
        const float one = said(as, q + i * width);
        if (!as->lowest) value += one;
        else if (one < value) value = one;
    }
    if (!as->lowest) value /= (float)net->heads;
    return as->mean + value * as->std;
}

/* J of a plan, as `Account` sums it; `of` and `actions` are those of its row. */
static float worth_of(const Job *job, Answers of, const float *actions) {
    const Network *net = job->net;
    const Reading *as = &net->reading;
    const float base = as->rule == PAPER ? 0.0f : as->floor;
    float above = 0.0f, below = 0.0f, share = 1.0f, weight = 1.0f, nothing = job->root->nothing;
    for (int k = 0; k < job->steps; k++, of.q += net->heads * job->width) {
        const int value = asks_value(as, k, job->steps);
        const float worth = value ? value_of(net, of.q, job->width) : of.earned[k] * as->std;
        const float floor = value ? base : (1.0f - as->discount) * base;
        above += weight * share * (worth - floor);
        below += weight * floor;
        if (!value) weight *= as->discount;
        if (k == 0) continue; /* the first state was seen alive */
        const float risk = one_sigmoid(of.dead[k]);
        share *= as->rule == SURVIVAL ? 1.0f - risk : risk <= as->threshold;
    }
    for (int i = 0; i < job->steps * net->actions; i++) nothing += 0.0f * actions[i];
    return (as->objective == VALUE ? above / (float)job->steps + base : above + below) + nothing;
}

/* A block of candidates from `row` on; rows beyond the last repeat the first. */
static void judge_block(const Job *job, int row) {
    const int steps = job->steps, per_row = steps * job->net->actions;
    const int q_row = steps * job->net->heads * job->width;
    const int count = row + ROWS <= job->rows ? ROWS : job->rows - row;
    const float *actions = job->actions + (int64_t)row * per_row;
    float some[ROWS * per_row], q[ROWS * q_row], earned[ROWS * steps], dead[ROWS * steps];
    memset(q, 0, sizeof q);
    memset(earned, 0, sizeof earned);
    memset(dead, 0, sizeof dead);
    if (count < ROWS) {
        for (int r = 0; r < ROWS; r++)
            memcpy(some + r * per_row, actions + (r < count ? r : 0) * per_row, per_row * sizeof(float));
        actions = some;
    }
    block(job->net, job->root, steps, actions, job->noise, job->width, (Answers){q, earned, dead});
    for (int r = 0; r < count; r++)
        job->worth[row + r] = worth_of(job, (Answers){q + r * q_row, earned + r * steps, dead + r * steps},
                                       actions + r * per_row);
}

static void blocks(Job *job) {
    take_tiles();
    for (int row; (row = __atomic_fetch_add(&job->crew.next, ROWS, __ATOMIC_RELAXED)) < job->rows;)
        judge_block(job, row);
    release_tiles();
}

/* All plans of a job are judged when this returns. */
void judge(Job *job) {
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
