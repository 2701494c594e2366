# Fuzzers of scene files and of the blobs that carry meshes and textures.
tessera_fuzzer(fuzz_obj LIBS tessera_scene_io)
tessera_fuzzer(fuzz_ply LIBS tessera_scene_io)
tessera_fuzzer(fuzz_gltf LIBS tessera_scene_io)
tessera_fuzzer(fuzz_mesh LIBS tessera_core)
