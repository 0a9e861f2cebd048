"""Options of the releases that do not affect a golden file.

They are about training, data, evaluation, initial values, or what other options turn off.
"""

_NAMES = """
    anchor_radius_affects_bias anchor_radius_init anchor_radius_min batch_size bg_color
    camera_normalization_method camera_scale_method checkpoint_save_every
    clip_head_readout_std clip_head_z_init data_mode dataset_kwargs dataset_max_gap
    dataset_min_gap debug_dump_iteration debug_dump_path debug_replay_batch_path
    dec_init_values deferred_bp depthsplat_experiment depthsplat_far
    depthsplat_lowest_feature_resolution depthsplat_monodepth_vit_type depthsplat_near
    depthsplat_num_scales depthsplat_upsample_factor detect_anomaly eval_n_media_dumps
    evaluating experiment_name final_div_factor geo_sparse_sampling_mode
    geo_sparse_sampling_tau_init gradient_accumulation_steps gradient_clip
    init_dynamic_tokens_from_static init_latents_from_existing init_tokens_from_existing
    lambda_anchor_visibility lambda_dyn_aux lambda_dyn_aux_decay_steps lambda_dyn_aux_min
    lambda_dyn_aux_warmup_steps lambda_lpips lambda_mask lambda_opacity lambda_rgb
    lambda_ssim lambda_visibility latent_cross_attn_depth log_image_freq lr
    max_iters_per_epoch mean_of_grads mean_of_grads_scene_chunk_size
    mean_of_grads_view_chunk_size mixed_precision model_type multiscale_encoder_layers
    num_epochs num_input_views num_latents num_views num_workers out_dir pct_start_steps
    pointmap_trim_hi pointmap_trim_lo print_freq project_name random_reflect resume
    rgb_loss_type seed strict_checkpoint_loading time_embedding_dim ttt_lr ttt_mode
    ttt_n_steps use_input_supervision use_interp_target use_ttt_for_eval use_wandb
    visibility_distance_threshold workspace zfar znear
"""

IDLE_OPTIONS = frozenset(_NAMES.split())
