#!/usr/bin/env bash
# Experts x fusions, trained from the store of params.yaml and compared in reports/comparison:
#   bash experiments/experts.sh [--params FILE] [--set section.key=value …]
# Stopped, the same command goes on: a finished training is kept, a stopped one resumed.
set -euo pipefail
cd "$(dirname "$0")/.."

for expert in regression diffusion flow_matching; do
    for fusion in concat cross_attention gated none; do
        # Somewhat longer than the default run: experts that sample learn more slowly than one that
        # predicts; the best evaluation is kept.
        python -m stages.train_head --set train_head.max_steps=600 --set train_head.eval_every=100 \
            "$@" \
            --set train_head.model_type=$expert \
            --set train_head.fusion_strategy=$fusion \
            --set train_head.output=models/experiments/$expert-$fusion \
            --set train_head.logs=reports/experiments_training/$expert-$fusion
        python -m stages.evaluate "$@" \
            --set evaluate.checkpoint=models/experiments/$expert-$fusion \
            --set evaluate.output=reports/experiments/$expert-$fusion \
            --set evaluate.modalities=false
    done
done
python -m stages.compare "$@" --set compare.reports=reports/experiments
