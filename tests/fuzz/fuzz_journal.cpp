// A journal in which bytes have changed gives valid scenes, or a UserError. The input says which
// bytes: four of it are one change, three for the place and one for the value.

#include <iterator>

#include "server/journal.h"
#include "tests/fuzz/fuzz_folder.h"
#include "tests/fuzz/small_scene.h"

namespace {

using namespace tessera;

const std::filesystem::path& journal_folder() {
    static const std::filesystem::path folder = fuzz_folder() / "journal";
    return folder;
}

/// The file of a journal with a small scene in two versions.
std::vector<char> intact_journal() {
    const SceneBundle bundle = small_bundle();
    const auto first = std::make_shared<const SceneVersion>(SceneVersion{1, bundle.scene});
    SceneVersion next{2, bundle.scene};
    next.scene.instances[0].world_from_object[3].x = 5;
    const auto second = std::make_shared<const SceneVersion>(next);
    {
        Journal journal(journal_folder());
        journal.restore();
        const SceneChange added{"scene", nullptr, first, bundle.blobs};
        journal.commit({&added, 1});
        const SceneChange moved{"scene", first, second, bundle.blobs};
        journal.commit({&moved, 1});
    }
    std::ifstream file(journal_folder() / "journal.sqlite", std::ios::binary);
    return std::vector<char>(std::istreambuf_iterator<char>(file), {});
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* bytes, std::size_t size) {
    static const std::vector<char> intact = intact_journal();
    std::vector<char> changed = intact;
    for (std::size_t i = 0; i + 4 <= size; i += 4)
        changed[(bytes[i] << 16 | bytes[i + 1] << 8 | bytes[i + 2]) % changed.size()] =
            char(bytes[i + 3]);
    std::filesystem::remove_all(journal_folder());
    std::filesystem::create_directory(journal_folder());
    write_file(journal_folder() / "journal.sqlite", changed);
    try {
        Journal journal(journal_folder());
        for (const ReadyScene& scene : journal.restore()) validate(scene.scene->scene);
    } catch (const UserError&) {
    }
    return 0;
}
