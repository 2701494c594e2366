// tessera edit, record, replay: changes an open scene of a server from a script, or lists what can
// be changed; writes down what others change, and does it again.

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <chrono>
#include <filesystem>
#include <nlohmann/json.hpp>

#include "client/commands.h"
#include "client/edit_json.h"
#include "client/interrupt.h"
#include "client/recording.h"
#include "client/render_client.h"
#include "common/animate.h"
#include "common/check.h"
#include "common/clock.h"
#include "common/scene_io.h"

namespace tessera {
namespace {

using Clock = std::chrono::steady_clock;

struct EditOptions {
    std::string server;
    std::string keys;
    std::string scene;
    bool json = false;
    std::string name, kind, file, object;
    std::vector<float> vector;
    std::vector<std::string> assignments;
    float shape_error = 0;
    double seconds = 0;
    double speed = 1;
    std::vector<int> size{640, 480};
};

/// A connection and the scene to edit: the one named, else the only one.
class Editor {
public:
    explicit Editor(const EditOptions& options)
        : client_({.address = options.server,
                   .credentials = load_credentials(options.keys),
                   .tick = [this] { interrupt_.check(); },
                   .reconnects = true}),
          scene_(options.scene) {
        const std::vector<std::string>& known = client_.welcome().scenes;
        if (scene_.empty() && known.size() == 1) scene_ = known.front();
        if (scene_.empty())
            throw UserError(
                fmt::format("--scene: which one? Open are: {}", fmt::join(known, ", ")));
        client_.watch(scene_);
    }

    const Scene& scene() const { return client_.scene().scene; }

    void apply(const std::vector<EditOperation>& operations, const BlobStore& blobs = {}) {
        const EditResult result = client_.edit(scene_, operations, blobs);
        if (!result.complaints.empty())
            throw UserError(fmt::format("{}", fmt::join(result.complaints, "; ")));
    }

    void wait_until(Clock::time_point time) { client_.wait_until(time); }
    RenderClient& client() { return client_; }
    const std::string& scene_name() const { return scene_; }

private:
    Interrupt interrupt_;
    RenderClient client_;
    std::string scene_;
};

template <class T>
const T& find(const std::vector<T>& table, const char* kind, const std::string& name) {
    const auto found = std::find_if(table.begin(), table.end(),
                                    [&](const T& entry) { return entry.name == name; });
    if (found == table.end())
        throw UserError(fmt::format("there is no {} '{}'; `tessera edit list` tells what there is",
                                    kind, name));
    return *found;
}

// ---- list ---------------------------------------------------------------------------------------

std::string text(const vec3& v) { return fmt::format("{:g},{:g},{:g}", v.x, v.y, v.z); }

std::string shader_text(const Material& m) {
    if (m.shader.empty()) return {};
    std::string out = " shader=" + m.shader;
    for (const ShaderParameter& p : m.shader_parameters)
        out += fmt::format(" shader.{}={}", p.name, text(p.value));
    return out;
}

void print_table(const Scene& scene) {
    for (const Instance& i : scene.instances)
        fmt::print("instance  {:<24} at {:<28} object '{}'\n", i.name,
                   text(vec3(i.world_from_object[3])), scene.objects[i.object].name);
    for (const Material& m : scene.materials)
        fmt::print("material  {:<24} base_color={} metallic={:g} roughness={:g} emission={}{}\n",
                   m.name, text(m.base_color), m.metallic, m.roughness, text(m.emission),
                   shader_text(m));
    for (const Light& l : scene.lights)
        fmt::print("light     {:<24} {} position={} direction={} intensity={}\n", l.name,
                   light_kind_name(l.kind), text(l.position), text(l.direction), text(l.intensity));
    for (const Camera& c : scene.cameras)
        fmt::print("camera    {:<24} eye={} at={} up={} fov={:g}\n", c.name, text(c.eye),
                   text(c.at), text(c.up), c.fov_y);
    fmt::print("environment {:<22} radiance={} rotation={:g}\n", "",
               text(scene.environment.radiance), scene.environment.rotation);
}

// ---- move, set, ... -----------------------------------------------------------------------------

void move(Editor& editor, const EditOptions& options, bool relative) {
    vec3 to(options.vector[0], options.vector[1], options.vector[2]);
    const Instance& instance = find(editor.scene().instances, "instance", options.name);
    if (relative) to += vec3(instance.world_from_object[3]);
    editor.apply({moved(instance, to)});
}

void set(Editor& editor, const EditOptions& options) {
    nlohmann::json values = nlohmann::json::object();
    for (const std::string& assignment : options.assignments) {
        const std::size_t equals = assignment.find('=');
        if (equals == std::string::npos)
            throw UserError(fmt::format("`{}` is not FIELD=VALUE", assignment));
        values[assignment.substr(0, equals)] = value_of_text(assignment.substr(equals + 1));
    }
    editor.apply({operation_of_json({{"set", options.kind}, {"name", options.name}, {"to", values}},
                                    editor.scene())});
}

void remove(Editor& editor, const EditOptions& options) {
    const auto named = [&](const auto& entry) { return entry.name == options.name; };
    const std::vector<Light>& lights = editor.scene().lights;
    if (std::any_of(lights.begin(), lights.end(), named))
        return editor.apply({DeleteLight{options.name}});
    find(editor.scene().instances, "instance or light", options.name);
    editor.apply({DeleteInstance{options.name}});
}

/// Edits in the form of a file of timed edits, at once.
void apply_text(Editor& editor, const EditOptions& options) {
    Scene scene = editor.scene();
    std::vector<EditOperation> operations;
    for (const std::string& text : options.assignments) {
        const auto json = nlohmann::json::parse(text, nullptr, false);
        if (!json.is_object()) throw UserError(fmt::format("`{}` is no JSON object", text));
        operations.push_back(operation_of_json(json, scene));
        scene = apply_edits(std::move(scene), {operations.back()}).scene;
    }
    editor.apply(operations);
}

void create(Editor& editor, const EditOptions& options) {
    const std::vector<float> at = options.vector.empty() ? std::vector<float>(3) : options.vector;
    editor.apply({operation_of_json(
        {{"create", options.name}, {"object", options.object}, {"to", at}}, editor.scene())});
}

/// The motion of a scene file, once, in its own time: as many steps as the server takes.
void play_motion(Editor& editor, const Motion& motion, float shape_error) {
    constexpr std::chrono::milliseconds step{40};
    const auto start = Clock::now();
    std::size_t most_bytes = 0;
    float most_error = 0;
    for (auto now = start;; now = std::max(Clock::now(), now + step)) {
        editor.wait_until(now);
        const double seconds = std::chrono::duration<double>(now - start).count();
        const MotionEdits edits = edits_at(editor.scene(), motion, seconds, shape_error);
        editor.apply(edits.operations, edits.blobs);
        for (const EditOperation& operation : edits.operations)
            if (const auto* shaped = std::get_if<SetShape>(&operation)) {
                const auto blob = edits.blobs.find(shaped->shape);
                most_bytes = std::max(most_bytes, blob->size());
                most_error = std::max(most_error, tessera::shape_error(*blob));
            }
        if (seconds >= motion.duration()) break;
    }
    if (most_bytes > 0)
        fmt::print(stderr, "tessera: shapes of {:.1f} kB each, off by at most {:g} m\n",
                   1e-3 * double(most_bytes), most_error);
}

void play(Editor& editor, const EditOptions& options) {
    const std::string& file = options.file;
    const bool is_scene = file.ends_with(".glb") || file.ends_with(".gltf") ||
                          (!file.ends_with(".json") && !std::filesystem::exists(file));
    if (is_scene) {
        const LoadedScene loaded = load_scene(file);
        if (loaded.bundle.motion.empty())
            throw UserError(fmt::format("{}: nothing in it moves by itself", file));
        return play_motion(editor, loaded.bundle.motion, options.shape_error);
    }
    const std::vector<TimedEdit> edits = load_timed_edits(file, editor.scene());
    const auto start = Clock::now();
    for (const TimedEdit& edit : edits) {
        editor.wait_until(start + std::chrono::duration_cast<Clock::duration>(
                                      std::chrono::duration<double>(edit.seconds)));
        editor.apply(edit.operations);
    }
}

// ---- record, replay -----------------------------------------------------------------------------

/// What anybody changes, until interrupted or the time is up.
void record(const EditOptions& options) {
    Editor editor(options);
    Recorder recorder(editor.scene());
    const auto start = Clock::now();
    std::uint64_t seen = editor.client().scene().version;
    fmt::print(stderr, "tessera: records changes of {}; Ctrl-C ends it\n", editor.scene_name());
    try {
        while (options.seconds == 0 || seconds_since(start) < options.seconds) {
            editor.client().poll(std::chrono::milliseconds(20));
            if (std::exchange(seen, editor.client().scene().version) !=
                editor.client().scene().version)
                recorder.see(seconds_since(start), editor.scene());
        }
    } catch (const Interrupted&) {
        // What there is, is what was wanted.
    }
    recorder.save(options.file);
    fmt::print(stderr, "tessera: {} steps\n", recorder.steps().size());
    if (recorder.shapes_left_out() > 0)
        fmt::print(stderr,
                   "tessera: {} changes of vertices are not in the file: `tessera edit play` plays "
                   "them from the scene's own\n",
                   recorder.shapes_left_out());
}

/// Looks where a recording looks, and measures when pictures come.
class Onlooker {
public:
    Onlooker(const EditOptions& options, Editor& editor) : client_(editor.client()) {
        view_.request = 1;
        view_.spec.scene = editor.scene_name();
        view_.spec.size = {options.size[0], options.size[1]};
    }

    void look(const Camera& camera) {
        view_.spec.camera = camera;
        ++view_.stamp;
        asked_[view_.stamp] = Clock::now();
        client_.show(view_);
    }
    void take() {
        const std::optional<ShownPicture> picture = client_.take_picture();
        if (!picture) return;
        ++pictures_;
        const auto asked = asked_.find(picture->about.stamp);
        if (asked == asked_.end()) return;
        latencies_.push_back(1e3 * seconds_since(asked->second));
        asked_.erase(asked_.begin(), std::next(asked));
    }
    bool waits() const { return !asked_.empty(); }

    void print(std::size_t edits, double seconds) {
        std::sort(latencies_.begin(), latencies_.end());
        fmt::print("{} edits, {} views, {} pictures in {:.1f} s", edits, view_.stamp, pictures_,
                   seconds);
        if (!latencies_.empty())
            fmt::print("; from a view to its first picture {:.0f} ms (median), {:.0f} ms at most",
                       latencies_[latencies_.size() / 2], latencies_.back());
        fmt::print("\n");
    }

private:
    RenderClient& client_;
    View view_;
    std::map<std::uint64_t, Clock::time_point> asked_;  ///< views without a picture
    std::vector<double> latencies_;                     ///< milliseconds
    std::size_t pictures_ = 0;
};

void replay(const EditOptions& options) {
    Editor editor(options);
    Onlooker onlooker(options, editor);
    const std::vector<TimedEdit> steps = load_timed_edits(options.file, editor.scene());
    const auto start = Clock::now();
    std::size_t edits = 0;
    for (const TimedEdit& step : steps) {
        const auto due = start + from_seconds(step.seconds / options.speed);
        do {
            editor.client().poll(std::chrono::milliseconds(Clock::now() < due ? 2 : 0));
            onlooker.take();
        } while (Clock::now() < due);
        edits += step.operations.size();
        if (!step.operations.empty()) editor.apply(step.operations);
        if (step.view) onlooker.look(*step.view);
    }
    while (onlooker.waits()) {
        editor.client().poll(std::chrono::milliseconds(20));
        onlooker.take();
    }
    onlooker.print(edits, seconds_since(start));
}

/// Of commands that work on an open scene.
void add_scene_options(CLI::App* command, EditOptions& options) {
    command->add_option("--server", options.server, "HOST:PORT of the server")->required();
    add_keys_option(command, options.keys);
    command->add_option("--scene", options.scene, "which of its scenes (default: the only one)");
}

}  // namespace

void add_record_commands(CLI::App& app) {
    auto options = std::make_shared<EditOptions>();
    CLI::App* recording = app.add_subcommand("record", "Write down what anybody changes");
    recording->add_option("FILE", options->file, "as `edit play` reads it")->required();
    add_scene_options(recording, *options);
    recording->add_option("--seconds", options->seconds, "end after so long (default: Ctrl-C)")
        ->check(CLI::PositiveNumber);
    recording->callback([options] { record(*options); });

    CLI::App* replaying = app.add_subcommand(
        "replay", "Look and change as a recording did, and tell how fast pictures came");
    replaying->add_option("FILE", options->file, "of `tessera record`, or of `tessera view` (R)")
        ->required();
    add_scene_options(replaying, *options);
    replaying->add_option("--speed", options->speed, "how many times as fast")
        ->check(CLI::Range(0.01, 1000.0));
    replaying->add_option("--size", options->size, "WxH of the pictures")
        ->delimiter('x')
        ->expected(2)
        ->check(CLI::Range(1, 16384));
    replaying->callback([options] { replay(*options); });
}

void add_edit_command(CLI::App& app) {
    auto options = std::make_shared<EditOptions>();
    CLI::App* command = app.add_subcommand("edit", "Change a scene that a server holds");
    add_scene_options(command, *options);
    command->require_subcommand(1);
    command->fallthrough();
    const auto add = [&](const char* name, const char* help, auto work) {
        CLI::App* sub = command->add_subcommand(name, help);
        sub->callback([options, work] {
            Editor editor(*options);
            work(editor, *options);
        });
        return sub;
    };
    const auto add_name = [&](CLI::App* sub) {
        sub->add_option("NAME", options->name)->required();
        return sub;
    };
    const auto add_vector = [&](CLI::App* sub, const char* help) {
        return sub->add_option("PLACE", options->vector, help)->delimiter(',')->expected(3);
    };
    add("list", "instances, materials, lights and cameras",
        [](Editor& editor, const EditOptions& o) {
            o.json ? fmt::print("{}\n", json_of(editor.scene()).dump(2))
                   : print_table(editor.scene());
        })
        ->add_flag("--json", options->json, "as JSON");
    add_vector(add_name(add("move", "put an instance's origin at a place",
                            [](Editor& e, const EditOptions& o) { move(e, o, false); })),
               "x,y,z in metres")
        ->required();
    add_vector(add_name(add("shift", "move an instance by so much",
                            [](Editor& e, const EditOptions& o) { move(e, o, true); })),
               "x,y,z in metres")
        ->required();
    add("apply", "any edits, at once", apply_text)
        ->add_option("EDIT", options->assignments,
                     "as in a file of timed edits: '{\"create object\": \"blue cup\", "
                     "\"like\": \"red cup\", \"materials\": [\"blue\"]}'")
        ->required();
    CLI::App* setting = add("set", "change fields of a material, light or camera", set);
    setting->add_option("KIND", options->kind)
        ->required()
        ->check(CLI::IsMember({"material", "light", "camera"}));
    add_name(setting)
        ->add_option("FIELDS", options->assignments,
                     "FIELD=VALUE as `list` prints them: base_color=0.8,0.1,0.1 roughness=0.2")
        ->required();
    add_name(add("delete", "an instance or light", remove));
    CLI::App* creating = add_name(add("create", "a new instance of an object", create));
    creating->add_option("OBJECT", options->object)->required();
    add_vector(creating, "where: x,y,z in metres");
    CLI::App* playing =
        add("play", "the timed edits of a JSON file, or what moves in a scene", play);
    playing->alias("animate");
    playing
        ->add_option("FILE", options->file,
                     "[{\"time\": seconds, \"edits\": [...]}, ...] in a .json file; or the scene "
                     "that the server holds, for its motion")
        ->required();
    playing
        ->add_option("--shape-error", options->shape_error,
                     "vertices that move may be off by so much, in metres of their object, and "
                     "travel in fewer bytes")
        ->check(CLI::PositiveNumber);
}

}  // namespace tessera
